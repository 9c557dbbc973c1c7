"""Eyes as a file, with the names of the kinds that the heads tell apart: in bfloat16, but for the heads of tokens.

Those are as large as the tower and only tests read them: they are kept as whole numbers up to 127 and a scale a row.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.perception.heads import FINE, Heads, Said
from lerobot_memobench.perception.neck import FINER, STEPS, Neck
from lerobot_memobench.perception.second_look import SecondLook
from lerobot_memobench.perception.tower import BLOCKS, GRID, POOLED, WIDTHS, Tower, fold

SHIPPED = Path(__file__).parent / "eyes.safetensors"
"""The eyes that come with the package: docs/eyes.md."""
PACKAGE, RANDOM = "package", "random"
"""Names of eyes that are no file's: those of the package, and none, where a policy's tower has random weights."""

WHOLE, SCALE = ("heads.", "pooled_heads."), " scale"
"""Where the weights that are kept as whole numbers are, and what follows their names where their scales are."""
READINGS = ("fine", "tokens", "pooled")
"""What is read off: the finer map, the 64 tokens, and the 16 pooled ones."""


class Eyes(nn.Module):
    """Tower, neck and heads.

    Args:
        tower: makes the tokens. kinds: names of the kinds of things that the heads tell apart.

    Attributes:
        fine_heads, heads, pooled_heads: of the neck's finer map, of the 64 tokens, and of the 16 pooled ones.
        second_look: at what is found by the finer map.
    """

    def __init__(self, tower: Tower, kinds: tuple[str, ...]) -> None:
        super().__init__()
        self.tower, self.neck, self.kinds = tower, Neck(tower), kinds
        self.fine_heads = Heads(self.neck.width, len(kinds), FINER * GRID, FINE // FINER, 1, doubting=True)
        self.heads = Heads(tower.width, len(kinds), GRID)
        self.pooled_heads = Heads(tower.width, len(kinds), POOLED)
        self.second_look = SecondLook(self.neck.width, tower.widths[-2 - STEPS], len(kinds))

    def forward(self, images: Tensor) -> dict[str, Said]:
        """Say what pictures (N, 3, SIDE, SIDE) in [0, 1] show, by each of `READINGS`."""
        tokens, maps = self.tower.looked(images)
        pooled = self.pooled_heads(self.tower.pooled(tokens))
        return {"fine": self.read(self.neck(tokens, maps), maps), "tokens": self.heads(tokens), "pooled": pooled}

    def fold(self) -> None:
        """Make batch normalisation part of the convolutions: no more for training."""
        self.tower.fold()
        fold(self.neck)

    def find(self, images: Tensor) -> Said:
        """Say what pictures (N, 3, SIDE, SIDE) in [0, 1] show, by the finer map, which says it best."""
        tokens, maps = self.tower.looked(images)
        return self.read(self.neck(tokens, maps), maps)

    def read(self, fine: Tensor, maps: Sequence[Tensor]) -> Said:
        """Say what the finer map (N, (8 FINER)², its width) of pictures shows, the tower's maps at a second look."""
        said: Said = self.fine_heads(fine)
        return replace(said, sure=self.second_look(fine, maps[-1 - STEPS], said.heat))


def save_eyes(eyes: Eyes, path: Path) -> None:
    """Write eyes to a file, folded: they learn no more."""
    eyes.fold()
    tensors = {}
    for name, value in eyes.state_dict().items():
        kept = value.detach()
        if name.startswith(WHOLE) and kept.ndim > 1:
            scale = kept.abs().amax(dim=1, keepdim=True).clamp(min=1e-12) / 127
            tensors[name], tensors[name + SCALE] = (kept / scale).round().to(torch.int8).contiguous(), scale
        else:
            tensors[name] = kept.to(torch.bfloat16).contiguous()
    shape = {"widths": eyes.tower.widths, "blocks": eyes.tower.blocks, "kinds": eyes.kinds}
    write_file(path, save(tensors, {"eyes": json.dumps(shape)}))


def load_tower(name: str) -> Tower:
    """Return the tower of the eyes of that name, `PACKAGE` or a file, as policies look through it.

    Raises:
        MemobenchError: there are no such eyes, or their tower has other sizes than this version's.
    """
    tower = load_eyes(name).tower
    if (tower.widths, tower.blocks) != (WIDTHS, BLOCKS):
        raise MemobenchError(
            f"the tower of {name} has stages of widths {tower.widths} and blocks {tower.blocks}, and policies look "
            f"through {WIDTHS} and {BLOCKS}; name eyes of this version's `memobench eyes train`"
        )
    return tower


def eyes_file(name: str | Path) -> Path:
    """Return the file of the eyes of that name, `PACKAGE` or a path.

    Raises:
        MemobenchError: it is not there.
    """
    path = SHIPPED if str(name) == PACKAGE else Path(name).expanduser()
    if not path.is_file():
        raise MemobenchError(f"there is no file {path}; name one that `memobench eyes train` has written")
    return path


def load_eyes(name: str | Path) -> Eyes:
    """Return the eyes of that name, `PACKAGE` or a path, in float32, in evaluation.

    Raises:
        MemobenchError: the file is not there, or was not written by `save_eyes`.
    """
    path = eyes_file(name)
    try:
        with safe_open(path, framework="pt") as file:
            shape = json.loads(file.metadata()["eyes"])
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (not a dict)
        for scale in [key for key in tensors if key.endswith(SCALE)]:
            tensors[scale.removesuffix(SCALE)] *= tensors.pop(scale)
        eyes = Eyes(Tower(tuple(shape["widths"]), tuple(shape["blocks"])), tuple(shape["kinds"]))
        eyes.fold()
        eyes.load_state_dict(tensors)
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise MemobenchError(f"{path} holds no eyes ({reason}); name a file of `memobench eyes train`") from None
    return eyes.eval().to(memory_format=torch.channels_last)
