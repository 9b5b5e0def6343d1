"""State of a long computation on disk, so that a killed run goes on where it was.

A checkpoint stands outside a stage's declared outputs, is stamped with a fingerprint of settings, inputs and code,
and is removed when the stage has written its result. One that belongs to something else is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, one_line
from neuma_lib.io.weights import read_torch


class Checkpoint:
    """One state on disk.

    Args:
        path: file to keep it in.
        fingerprint: short texts or numbers that must be equal for a resumed run to mean the same thing, by name
            (see `workflow.provenance.fingerprint`).
    """

    def __init__(self, path: str | Path, fingerprint: Mapping[str, Any]):
        self.path = Path(path)
        self.fingerprint = {k: str(v) for k, v in fingerprint.items()}

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the state: weights, optimiser, scheduler, iteration; the generators' states are added."""
        generators: dict[str, Any] = {
            "torch": torch.get_rng_state()
        }  # the library uses no global one of numpy
        if torch.cuda.is_available():
            generators["cuda"] = torch.cuda.get_rng_state_all()
        content = {"fingerprint": self.fingerprint, "generators": generators, "state": dict(state)}
        with atomic(self.path) as partial:
            torch.save(content, partial)

    def load(self) -> dict[str, Any] | None:
        """The saved state, with the random generators put back; None where there is none.

        Raises:
            InputError: the file is damaged, or belongs to other settings, inputs or code.
        """
        if not self.path.exists():
            return None
        remedy = f"remove it to start again:  rm '{self.path}'"
        try:
            content = dict(read_torch(self.path))
            found, generators, state = (content[key] for key in ("fingerprint", "generators", "state"))
            names = sorted({*found.keys(), *self.fingerprint})
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"checkpoint {self.path} cannot be read ({one_line(error)}); {remedy}") from None
        pairs = {k: (found.get(k, "absent"), self.fingerprint.get(k, "absent")) for k in names}
        if changed := [f"{k} (was {was}, is {now})" for k, (was, now) in pairs.items() if was != now]:
            raise InputError(
                f"checkpoint {self.path} belongs to another run: {one_line(', '.join(changed), 500)} changed since;"
                f" go back to the former settings to resume it, or {remedy}"
            )
        torch.set_rng_state(generators["torch"])
        if "cuda" in generators and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(generators["cuda"][: torch.cuda.device_count()])
        return state

    def remove(self) -> None:
        """Forget the state: the result is written."""
        self.path.unlink(missing_ok=True)
