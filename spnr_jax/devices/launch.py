"""A process joins the others of its training, as its launcher says or at given addresses."""

import os

import jax

from spnr_jax.errors import UserError

END_TIMEOUT = 30  # seconds that a process which ended waits for the others
HEARTBEAT_TIMEOUT = 20  # seconds of silence after which a process counts as gone, and the others end
# XLA's CPU runtime begins sums that do not need each other in any order: gloo of two processes then mixes them up
IN_ORDER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"


def join(coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None) -> None:
    """Joins this process to the others of its training, before anything else of JAX runs.

    Without arguments JAX asks the launcher's environment (SLURM, Open MPI, Kubernetes).  ValueError if that says
    nothing, or the others cannot be reached.
    """
    given = coordinator, num_processes, process_id
    if None in given and given != (None, None, None):
        raise UserError("--coordinator, --num-processes and --process-id: expected all three, or none in a launcher")
    if num_processes is not None and not 0 <= (process_id or 0) < num_processes:
        raise UserError(f"--process-id {process_id}: expected 0 to {num_processes - 1} of --num-processes")
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {IN_ORDER}".strip()
    try:
        jax.distributed.initialize(
            *given, heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT, shutdown_timeout_seconds=END_TIMEOUT
        )
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"the processes do not find each other ({error}); start them by srun, mpirun or an indexed Kubernetes job, "
            "or give --coordinator HOST:PORT --num-processes N --process-id I"
        ) from None
