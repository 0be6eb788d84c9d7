"""Who may use several threads: the kernels, and not the linear algebra beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numba as nb
from threadpoolctl import threadpool_limits


def leave_threads_to_kernels() -> None:
    """Let BLAS work in one thread, in the whole process.

    Its threads wait busily for their next call and keep the kernels' from running: on two cores a
    frame of a sequence took four times as long with both.
    """
    threadpool_limits(limits=1, user_api="blas")


def in_threads(work: Callable[[int], None], items: Iterable[int]) -> None:
    """Call ``work`` for each item on as many threads as the kernels use; it must let others run."""
    with ThreadPoolExecutor(nb.get_num_threads()) as threads:
        for _ in threads.map(work, items):
            pass
