"""Settings of the tests of the studies."""

from __future__ import annotations

import torch

torch.set_num_threads(1)
