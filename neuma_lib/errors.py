"""The two errors that users meet: an input that they can mend, and a number that is no longer one."""

from __future__ import annotations


class InputError(ValueError):
    """A file, key or value given by the user cannot be used; the message names it and says what to do."""


class NonFiniteError(ArithmeticError):
    """A simulated or optimised quantity became NaN or infinite.

    Args:
        stage: pipeline stage or function in which it happened.
        detail: what is known of the place (iteration, step, particle) and what to try.
        step: simulation step at which it happened, if known.
        particle: first particle that it happened to, if known.
        happened: what did, in words that follow "a particle".
    """

    def __init__(
        self,
        stage: str,
        detail: str,
        step: int | None = None,
        particle: int | None = None,
        happened: str = "became non-finite",
    ):
        super().__init__(f"{stage}: {detail}")
        self.stage = stage
        self.detail = detail
        self.step = step
        self.particle = particle
        self.happened = happened
