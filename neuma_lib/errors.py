"""The errors that users meet: `InputError` for an input to correct, `NonFiniteError` for a diverged computation."""

from os import PathLike


class InputError(ValueError):
    """A file, key or value given by the user cannot be used.

    Args:
        where: file, key or argument that is wrong.
        problem: what is wrong with it, with the given value.
        remedy: what the user can do. Empty if it follows from the problem.
    """

    def __init__(self, where: str | PathLike, problem: str = "", remedy: str = ""):
        self.where = str(where)
        self.problem = str(problem)
        self.remedy = str(remedy)
        text = f"{self.where}: {self.problem}" if problem else self.where
        super().__init__(f"{_sentence(text)} {_sentence(self.remedy)}" if remedy else text)

    def __reduce__(self):
        return type(self), (self.where, self.problem, self.remedy)


class NonFiniteError(ArithmeticError):
    """A simulated or optimised quantity became NaN or infinite.

    Args:
        stage: pipeline stage or function.
        detail: iteration, step and particle if known, and a remedy.
        step: simulation step, if known.
        particle: first affected particle, if known.
        happened: the event, in words that follow "a particle".
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


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?", "!")) else f"{text}."
