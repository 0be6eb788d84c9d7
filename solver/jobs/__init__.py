"""The jobs: a module for each kind, named as the kind, with ``run(task)``.

Each reads files, writes what it leaves into a folder and reports progress. A worker calls them in a
process of its own, the offline command line directly.
"""

from solver.jobs.task import Task, run_job

__all__ = ["Task", "run_job"]
