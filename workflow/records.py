"""What Snakemake remembers of a job that failed: what it remembered before."""

from __future__ import annotations


def keep_records_of_failed_jobs(persistence) -> None:
    """From now on a job counts as finished only if its outputs are there. To be called when a run begins.

    Snakemake notes settings and code of a job that fails, too, and removes its outputs. What had been made of these
    with former settings or code then counts as up to date: the same command again finds nothing to do, and a table
    shows what it showed before. With the former note the job runs again.

    Args:
        persistence: Snakemake's.
    """
    finished = persistence.finished

    async def finished_with_outputs(job) -> None:
        if all([await file.exists() for file in job.output]):
            await finished(job)

    persistence.finished = finished_with_outputs
