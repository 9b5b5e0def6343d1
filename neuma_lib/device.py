"""Where to compute."""

from __future__ import annotations

import torch

from neuma_lib.errors import InputError


def choose_device(name: str = "auto") -> torch.device:
    """The device of that name; "auto" takes CUDA where there is one.

    Raises:
        InputError: CUDA is asked for and torch sees none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(
            "device: cuda is asked for, but torch sees no CUDA device; set device: cpu, or mend the driver"
        )
    return torch.device(name)
