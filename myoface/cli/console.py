"""Output of the command line: tables, progress bars, and errors on one line."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.cells import cell_len, set_cell_size
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import (
    BarColumn,
    DownloadColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TransferSpeedColumn,
)
from rich.progress import Progress as Bars
from rich.segment import Segment

from myoface.client.files import Transferred
from myoface.resources import Job, Progress

if TYPE_CHECKING:
    from solver.progress import Step

VERDICTS = {
    "good": ("green", "good"),
    "usable": ("yellow", "usable, with flaws"),
    "bad": ("red", "bad: it cannot be used"),
}

# Between two lines about one phase, where there is no terminal to show a live bar.
NEWS_SECONDS = 10.0

# Characters that do something to a terminal, or to the order of what it shows (C0, C1, bidi), but
# for the end of a line; and halves of surrogate pairs, which cannot be written
HARMFUL = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Return a stranger's text as a terminal may see it: harmful characters as escapes."""
    return HARMFUL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class SafeConsole(Console):
    """A console on which no text, wherever it is from, does more than be read."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render, with the harmful characters of all texts escaped."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


out = SafeConsole(highlight=False, soft_wrap=True)
err = SafeConsole(stderr=True, highlight=False, soft_wrap=True)


def complain(message: str) -> None:
    """Show an error."""
    err.print(f"[bold red]error:[/] {escape(message)}")


def show_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Show rows under column names, one line a row, however wide: an id stays whole."""
    lines = [list(columns), *(["" if cell is None else str(cell) for cell in row] for row in rows)]
    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        text = "  ".join(map(set_cell_size, line, widths)).rstrip()
        out.print(text, markup=False, style=None if number else "bold")


def show_verdict(title: str, check: Mapping[str, Any]) -> None:
    """Show the verdict of a check of a scan, and each finding with its advice."""
    style, words = VERDICTS[check["verdict"]]
    out.print(f"{escape(title)}: [{style}]{words}[/]")
    _show_findings(check["findings"])


def show_registration(title: str, registration: Mapping[str, Any]) -> None:
    """Show how near a registered face is to its scan, and each finding with its advice."""
    words = f"registered, {registration['coverage']:.0%} of the face seen"
    if registration["mean_mm"] is not None:
        words += f", {registration['mean_mm']:.2f} mm off the scan on average"
    out.print(f"{title}: {words}", markup=False)
    _show_findings(registration["findings"])


def _show_findings(findings: Iterable[Mapping[str, str]]) -> None:
    for finding in findings:
        out.print(f"  - {finding['message']}", markup=False)
        if finding.get("advice"):
            out.print(f"    {finding['advice']}", markup=False)


@contextmanager
def transfer_bar(title: str) -> Iterator[Transferred]:
    """Show a bar for bytes; yields a function of the bytes done and the bytes in all."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    with Bars(*columns, console=out, transient=True, disable=not out.is_terminal) as bars:
        task = bars.add_task(escape(title), total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


class JobView:
    """Shows a job's phase, iteration and mean error while it runs, and times its phases.

    On a terminal it is a live bar; elsewhere (a log, CI) a line for every phase, and one for its
    news now and then. ``phases`` holds phase -> seconds afterwards.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.phases: dict[str, float] = {}
        self._phase = "queued"
        self._since = time.monotonic()
        self._last_line = ("", 0.0)
        self._warned: set[str | None] = set()
        self._bars = Bars(
            TextColumn("{task.fields[title]}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=out,
            transient=True,
            disable=not out.is_terminal,
        )
        self._task = self._bars.add_task("queued", total=1.0, title=escape(title))

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self._turn("end")
        self._bars.stop()

    def watch(self, job: Job) -> None:
        """Take a job's news (a :data:`myoface.client.Watcher`)."""
        if job.state == "queued" or job.progress is None:
            self._show(Progress(phase=job.state, fraction=0.0))
        else:
            self._show(job.progress)

    def __call__(self, step: Step, /) -> None:
        """Take the news of a computation in this process (a :class:`solver.progress.Progress`)."""
        self._show(step)

    def _show(self, step: Step | Progress) -> None:
        if step.phase == "warning":
            if step.message not in self._warned:
                self._warned.add(step.message)
                out.print(f"{self.title}: warning: {step.message}", markup=False)
            return
        words, turns = summary(step), step.phase != self._phase
        if turns:
            self._turn(step.phase)
        if not out.is_terminal:
            self._print(words, at_once=turns)
        self._bars.update(self._task, completed=step.fraction, description=escape(words))

    def _print(self, words: str, *, at_once: bool) -> None:
        """Print a line, unless it says nothing new or the one before is not old yet."""
        before, moment = self._last_line
        now = time.monotonic()
        if at_once or (words != before and now - moment >= NEWS_SECONDS):
            self._last_line = (words, now)
            out.print(f"{self.title}: {words}", markup=False)

    def _turn(self, phase: str) -> None:
        moment = time.monotonic()
        self.phases[self._phase] = self.phases.get(self._phase, 0.0) + moment - self._since
        self._phase, self._since = phase, moment


def summary(step: Step | Progress) -> str:
    """Return a step as a few words: phase, iteration, mean error."""
    words = [step.phase]
    if step.iteration is not None:
        words.append(f"iteration {step.iteration}")
    if step.mean_error_mm is not None:
        words.append(f"mean {step.mean_error_mm:.3f} mm")
    if step.message:
        words.append(step.message)
    return " · ".join(words)
