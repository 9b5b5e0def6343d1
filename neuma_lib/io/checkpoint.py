"""State of a long computation on disk, from which an interrupted run resumes.

A checkpoint is not a declared output of its stage. It holds a fingerprint of settings, inputs and code, is rejected
if the fingerprint differs, and is removed when the stage has written its result.
"""

import io
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
        path: file of the state.
        fingerprint: name -> short text or number; a run resumes only if all are equal (see
            `workflow.provenance.fingerprint`).
    """

    def __init__(self, path: str | Path, fingerprint: Mapping[str, Any]):
        self.path = Path(path)
        self.fingerprint = {k: str(v) for k, v in fingerprint.items()}

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the state (weights, optimiser, scheduler, iteration); states of the random generators are added."""
        # the library does not use numpy's global generator
        generators: dict[str, Any] = {"torch": torch.get_rng_state()}
        if torch.cuda.is_available():
            generators["cuda"] = torch.cuda.get_rng_state_all()
        content = {"fingerprint": self.fingerprint, "generators": generators, "state": dict(state)}
        buffer = io.BytesIO()  # on a full disk torch.save does not name the reason
        torch.save(content, buffer)
        with atomic(self.path) as partial:
            partial.write_bytes(buffer.getbuffer())

    def load(self) -> dict[str, Any] | None:
        """The saved state, or None if there is none. Restores the random generators.

        Raises:
            InputError: the file is damaged, or belongs to other settings, inputs or code.
        """
        if not self.path.exists():
            return None
        delete = f"rm '{self.path}'"
        try:
            content = dict(read_torch(self.path))
            saved, generators, state = (content[key] for key in ("fingerprint", "generators", "state"))
            names = sorted({*saved.keys(), *self.fingerprint})
            torch.Generator().set_state(generators["torch"])
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            reason = error.problem if isinstance(error, InputError) else error
            problem = f"is not a valid checkpoint: {one_line(reason)}"
            raise InputError(self.path, problem, f"Start again with: {delete}") from None
        pairs = {k: (saved.get(k, "absent"), self.fingerprint.get(k, "absent")) for k in names}
        if changed := [f"{k} (was {was}, is {now})" for k, (was, now) in pairs.items() if was != now]:
            raise InputError(
                self.path,
                f"is the checkpoint of another run: {one_line(', '.join(changed), 500)} changed",
                f"Restore the former settings to resume, or start again with: {delete}",
            )
        torch.set_rng_state(generators["torch"])
        if "cuda" in generators and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(generators["cuda"][: torch.cuda.device_count()])
        return state

    def remove(self) -> None:
        """Delete the state after the result is written."""
        self.path.unlink(missing_ok=True)
