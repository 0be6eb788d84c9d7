"""Who may use several threads: the kernels, and not the linear algebra beside them."""

from __future__ import annotations

from threadpoolctl import threadpool_limits


def leave_threads_to_kernels() -> None:
    """Let BLAS work in one thread, in the whole process.

    Its threads wait busily for their next call and keep the kernels' from running: on two cores a
    frame of a sequence took four times as long with both.
    """
    threadpool_limits(limits=1, user_api="blas")
