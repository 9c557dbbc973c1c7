"""Draw a model's initial state: ``python -m mujoco_raster model.xml image.png``."""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco

from mujoco_raster.renderer import SAMPLES, Renderer


def main(arguments: list[str] | None = None) -> None:
    """Write an image of a model; errors of the model, the camera and the files end with status 2."""
    parser = argparse.ArgumentParser("python -m mujoco_raster", description="Draw a MuJoCo model on the CPU.")
    parser.add_argument("model", type=Path, help="MJCF or URDF file, or a compiled model (.mjb)")
    parser.add_argument("image", type=Path, help="image to write; its ending chooses the format (.png, .jpg)")
    parser.add_argument("--camera", help="name or id of a camera; default: the free camera")
    parser.add_argument("--keyframe", help="name or id of a keyframe; default: the initial state")
    parser.add_argument("--width", type=int, default=640, help="pixels (default: 640)")
    parser.add_argument("--height", type=int, default=480, help="pixels (default: 480)")
    parser.add_argument("--samples", type=int, default=4, choices=SAMPLES, help="samples per pixel (default: 4)")
    given = parser.parse_args(arguments)
    try:
        draw(given.model, given.image, given.camera, given.keyframe, given.height, given.width, given.samples)
    except (ValueError, KeyError, OSError) as error:  # of MuJoCo, this package, Pillow and the file system
        parser.error(str(error.args[0] if isinstance(error, KeyError) else error).strip())


def draw(
    file: Path, image: Path, camera: str | None, keyframe: str | None, height: int, width: int, samples: int
) -> None:
    """Write an image of a model file; see the command's arguments.

    Raises:
        ValueError: MuJoCo cannot read the model, or the camera or the format of the image is unknown.
        KeyError: the keyframe is unknown.
        OSError: the image cannot be written.
    """
    from PIL import Image

    if image.suffix.lower() not in Image.registered_extensions():
        raise ValueError(f"{image} has no ending of a known image format; use .png")
    read = mujoco.MjModel.from_binary_path if file.suffix == ".mjb" else mujoco.MjModel.from_xml_path
    model = read(str(file))
    data = mujoco.MjData(model)
    if keyframe is not None:
        key = model.key(int(keyframe) if keyframe.isdigit() else keyframe)
        mujoco.mj_resetDataKeyframe(model, data, key.id)
    mujoco.mj_forward(model, data)
    with Renderer(model, height, width, samples=samples) as renderer:
        number = camera is not None and camera.lstrip("-").isdigit()
        renderer.update_scene(data, -1 if camera is None else int(camera) if number else camera)
        Image.fromarray(renderer.render()).save(image)


if __name__ == "__main__":
    main()
