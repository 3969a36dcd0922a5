"""Names of the concurrency limits in Prefect that flows share.

A limit that does not exist at the server has no effect, so the setup of a server creates them
(infra.serving.deployments).
"""

DISK_LIMIT = "trilight-disk"
"""Limit of runs that write documents at the same time."""
GPU_LIMIT = "trilight-gpu"
"""Limit of tasks that render or train on a GPU at the same time."""
