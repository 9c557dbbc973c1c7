"""Draw textures with Pillow: wood, metal and labels, as (H, W, 3) uint8 arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.sim.assets.meshes import BOX_FACES

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]
Drawing = Callable[["Canvas"], None]

WHITE: Colour = (250, 250, 245)
BLACK: Colour = (20, 20, 22)


class Canvas:
    """A drawing with coordinates from 0 to 1 in both directions, independent of the image size."""

    def __init__(self, width: int, height: int, colour: Colour) -> None:
        self.image = Image.new("RGB", (width, height), colour)
        self.draw = ImageDraw.Draw(self.image)
        self.width, self.height = width, height

    def xy(self, *points: float) -> list[tuple[float, float]]:
        """Return pixel pairs of fractions x0, y0, x1, y1, ..."""
        pairs = zip(points[::2], points[1::2], strict=True)
        return [(x * (self.width - 1), y * (self.height - 1)) for x, y in pairs]

    def rect(self, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        """Fill a rectangle."""
        self.draw.rectangle(self.xy(x0, y0, x1, y1), fill=colour)

    def oval(self, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        """Fill an ellipse."""
        self.draw.ellipse(self.xy(x0, y0, x1, y1), fill=colour)

    def shape(self, colour: Colour, *points: float) -> None:
        """Fill a polygon."""
        self.draw.polygon(self.xy(*points), fill=colour)

    def line(self, colour: Colour, width: float, *points: float) -> None:
        """Draw a line; ``width`` is a fraction of the image's width."""
        self.draw.line(self.xy(*points), fill=colour, width=max(1, round(width * self.width)), joint="curve")

    def text(self, words: str, x0: float, y0: float, x1: float, y1: float, colour: Colour, turn: int = 0) -> None:
        """Write bold ``words`` as large as the rectangle allows, rotated by ``turn`` x 90 degrees."""
        left, top, right, bottom = (round(v) for pair in self.xy(x0, y0, x1, y1) for v in pair)
        wide, high = max(1, right - left), max(1, bottom - top)
        font = ImageFont.load_default(96)
        stroke = 4
        box = self.draw.multiline_textbbox((0, 0), words, font=font, stroke_width=stroke, align="center")
        size = (int(box[2] - box[0]) + 2, int(box[3] - box[1]) + 2)
        mask = Image.new("L", size, 0)
        ImageDraw.Draw(mask).multiline_text(
            (1 - box[0], 1 - box[1]), words, fill=255, font=font, stroke_width=stroke, align="center"
        )
        if turn:
            mask = mask.rotate(90 * turn, expand=True)
        factor = min(wide / mask.width, high / mask.height)
        # Limit the aspect ratio of letters.
        stretch_x = min(wide / mask.width, factor * 1.35)
        stretch_y = min(high / mask.height, factor * 1.35)
        shown = mask.resize(
            (max(1, round(mask.width * stretch_x)), max(1, round(mask.height * stretch_y))),
            Image.Resampling.LANCZOS,
        )
        spot = (left + (wide - shown.width) // 2, top + (high - shown.height) // 2)
        self.image.paste(Image.new("RGB", shown.size, colour), spot, shown)

    def pixels(self) -> Pixels:
        """Return the image."""
        return np.asarray(self.image, dtype=np.uint8)


def draw_texture(width: int, height: int, colour: Colour, *steps: Drawing) -> Pixels:
    """Return a canvas after ``steps``."""
    canvas = Canvas(width, height, colour)
    for step in steps:
        step(canvas)
    return canvas.pixels()


def atlas(faces: Mapping[str, Pixels], colour: Colour, cell: int = 128) -> Pixels:
    """Return the 3 x 2 atlas of a box mesh; faces without an image are filled with ``colour``."""
    sheet = Image.new("RGB", (3 * cell, 2 * cell), colour)
    for k, face in enumerate(BOX_FACES):
        if face in faces:
            image = Image.fromarray(faces[face]).resize((cell, cell), Image.Resampling.LANCZOS)
            sheet.paste(image, ((k % 3) * cell, (k // 3) * cell))
    return np.asarray(sheet, dtype=np.uint8)


def wrapped(front: Pixels, side: Pixels, top: Pixels, colour: Colour) -> Pixels:
    """Return the atlas of a package with equal front and back, equal sides, and a top."""
    faces = {"+x": front, "-x": front, "+y": side, "-y": side, "+z": top}
    return atlas(faces, colour)


def wood(dark: Colour, light: Colour, seed: int, size: int = 256, waves: float = 5.0) -> Pixels:
    """Return a seamless wood texture with the grain along u."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:size, 0:size] / size
    bend = np.zeros((size, size))
    for k in range(1, 4):
        phase, phase2 = rng.uniform(0, 2 * np.pi, 2)
        bend += 0.05 / k * np.sin(2 * np.pi * k * u + phase) * np.cos(2 * np.pi * v + phase2)
    rings = np.zeros((size, size))
    for k in (1, 2, 3, 5, 9, 14):
        rings += np.sin(2 * np.pi * round(waves * k / 3 + 1) * (v + bend) + rng.uniform(0, 2 * np.pi)) / k**0.7
    noise = rng.normal(size=(size, size))
    fibres = np.real(np.fft.ifft2(np.fft.fft2(noise) * _fibre_filter(size)))
    fibres /= fibres.std()
    mix = 0.5 + 0.16 * rings + 0.09 * fibres
    mix = np.clip(mix, 0, 1)[..., None]
    colour = np.array(dark) * (1 - mix) + np.array(light) * mix
    return np.clip(colour, 0, 255).astype(np.uint8)


def _fibre_filter(size: int) -> NDArray[np.float64]:
    fv = np.fft.fftfreq(size)[:, None] * size
    fu = np.fft.fftfreq(size)[None, :] * size
    return np.exp(-((fu / 3.0) ** 2) - (fv / 60.0) ** 2)


def speckle(base: Colour, spread: float, seed: int, size: int = 64, along: float = 0.0) -> Pixels:
    """Return a seamless plain colour with fine noise, brushed along u if ``along`` > 0."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(size, size))
    if along > 0:
        fu = np.fft.fftfreq(size)[None, :] * size
        noise = np.real(np.fft.ifft2(np.fft.fft2(noise) * np.exp(-((fu * along) ** 2))))
        noise /= noise.std()
    return np.clip(np.array(base) + spread * noise[..., None], 0, 255).astype(np.uint8)
