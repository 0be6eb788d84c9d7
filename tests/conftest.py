"""Share the tests among processes, and choose those of `make quick`."""

from __future__ import annotations

import multiprocessing.process
import os
import subprocess
import time
import warnings
from collections.abc import Iterator
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, NoReturn

# Beside other workers, threads of BLAS only wait for each other; numpy reads this once.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# A solver that gives way to the tests beside it would wait for their end.
os.environ.setdefault("MYOFACE_SOLVER_NICENESS", "0")

import pytest
import structlog
from xdist.scheduler import LoadScopeScheduling

UNITS = tuple(f"tests/{folder}/" for folder in ("unit", "solver", "service", "worker", "myoface"))
QUICK_LIMIT = 0.6  # s of processor time that a test of `make quick` may take

SECONDS = "processor seconds"

# A logged error with all locals of its frames, in colours, takes ten seconds; services log none.
plain = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
structlog.configure(processors=[*structlog.get_config()["processors"][:-1], plain])

too_long: dict[str, float] = {}
began = pytest.StashKey[float]()


def pytest_addoption(parser: pytest.Parser) -> None:
    about = "unit tests that are neither slow nor long, need no data and start no process"
    parser.addoption("--quick", action="store_true", help=about)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Build what workers would else build at once: each the same, for 20 seconds."""
    if not getattr(session.config.option, "numprocesses", None):
        return
    from solver.errors import InputError
    from solver.templates.builtin.build import builtin_template

    try:
        builtin_template()
    except InputError as error:
        warnings.warn(f"no built-in anatomy: {error.message}", stacklevel=1)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave modules that `make quick` runs nothing of unread: importing them takes seconds."""
    if not config.option.quick or collection_path.is_dir():
        return None
    module = collection_path.relative_to(config.rootpath).as_posix()
    return None if module.startswith(UNITS) else True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        # integration/conftest.py runs a module on the servers as well
        if item.get_closest_marker("servers") and not item.get_closest_marker("telling"):
            item.add_marker("slow")
    if config.option.quick:
        left = [item for item in items if not _is_quick(item)]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if _is_quick(item)]
    elif hasattr(config, "workerinput"):
        items[:] = _mixed(items)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling:
    config.option.loadscopereorder = False
    return _ByModule(config, log)


class _ByModule(LoadScopeScheduling):
    """Give a module's tests, on the same parts, to one worker: it starts their servers once."""

    def _split_scope(self, nodeid: str) -> str:
        return _group(nodeid)


def _group(nodeid: str) -> str:
    module, _, test = nodeid.partition("::")
    return f"{module} on servers" if "[production" in test else module


def _is_quick(item: pytest.Item) -> bool:
    marks = {mark.name for mark in item.iter_markers()}
    return item.nodeid.startswith(UNITS) and not marks & {"slow", "long"}


def _mixed(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return the longest first, and those that compute beside those that wait."""
    groups: dict[str, list[pytest.Item]] = {}
    for item in items:
        groups.setdefault(_group(item.nodeid), []).append(item)

    def weight(name: str) -> int:
        marks = [mark.name for item in groups[name] for mark in item.iter_markers()]
        return -1000 * marks.count("end_to_end") - marks.count("long")

    computing = sorted((name for name in groups if name.startswith(UNITS)), key=weight)
    waiting = sorted((name for name in groups if not name.startswith(UNITS)), key=weight)
    pairs = chain.from_iterable(zip_longest(waiting, computing))
    return [item for name in pairs if name is not None for item in groups[name]]


@pytest.fixture(scope="session", autouse=True)
def quick_only(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let a test of `make quick` skip itself where it would read data or start a process."""
    if not request.config.option.quick:
        yield
        return

    def refuse(*_: Any, **__: Any) -> NoReturn:
        pytest.skip("starts a process")

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MYOFACE_DATA", "none in make quick")
        patch.setattr(subprocess.Popen, "__init__", refuse)
        patch.setattr(multiprocessing.process.BaseProcess, "start", refuse)
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[began] = time.process_time()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    item.user_properties.append((SECONDS, time.process_time() - item.stash[began]))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    seconds = dict(report.user_properties).get(SECONDS, 0.0)
    if report.when == "teardown" and seconds > QUICK_LIMIT:
        too_long[report.nodeid] = seconds


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if too_long and config.option.quick:
        terminalreporter.section("mark as long, unless kernels were compiled")
        for name, seconds in too_long.items():
            terminalreporter.write_line(f"{seconds:.1f} s of processor time: {name}")
