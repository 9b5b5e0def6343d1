"""Patches of Snakemake: records of failed jobs, deleted folders of results, and the limit of jobs a second."""

from pathlib import Path

from snakemake.persistence import PersistenceBase


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


def remake_deleted_folders(results: str) -> None:
    """From now on a file counts as incomplete if a folder of results that it was made of has been deleted.

    For Snakemake alone, a table that exists is up to date even if what it was made of does not exist any more. Deleting
    a method's folder would then not make it again for a table. Single files may still be deleted to save space.

    Args:
        results: folder of all results.
    """
    incomplete = PersistenceBase.incomplete

    async def incomplete_or_without_inputs(self, job) -> list:
        files = await incomplete(self, job)
        if files or not self.dag.workflow.dag_settings.force_incomplete:  # else they would be an error
            return files
        for file in job.input:
            folder = Path(file).parent
            if folder.is_relative_to(results) and not folder.exists() and self.metadata(file):
                return [made for made in job.output if await made.exists()]
        return []

    PersistenceBase.incomplete = incomplete_or_without_inputs


def start_local_jobs_at_once(workflow) -> None:
    """Remove the limit of 100 jobs a second from a local run, where the number of cores limits them already.

    With a limit, Snakemake 9.27 repeats each selection of jobs after a second, for as long as jobs are ready. Each job
    that ends adds such a repetition. After some hundred jobs Snakemake takes a core for itself and starts jobs late: on
    64 cores, 28 of 64 ran.

    Args:
        workflow: Snakemake's, when a run begins.
    """
    if workflow.local_exec:
        workflow.scheduler.job_rate_limiter = None
