"""Many jobs, each remembered: what is done and has not changed is not done again."""

from ceres_cal.batch.jobs import Job, Outcome
from ceres_cal.batch.plan import read_plan
from ceres_cal.batch.running import run_jobs

__all__ = ["Job", "Outcome", "read_plan", "run_jobs"]
