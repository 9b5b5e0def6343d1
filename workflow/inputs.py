"""Input files as Snakemake hands them to scripts."""


def listed(files) -> list[str]:
    """Named input files as a list: Snakemake gives one file as a text."""
    return [files] if isinstance(files, str) else list(files or ())
