"""Limits in Prefect of what flows share, by name.

One that does not exist at the server limits nothing, so whatever sets a server up makes them
(infra.serving.deployments).
"""

DISK_LIMIT = "trilight-disk"
"""Of runs that write documents."""
GPU_LIMIT = "trilight-gpu"
"""Of graphics cards that are rendered or learned on."""
