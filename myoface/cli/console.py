"""Output of the command line: tables, progress bars, and errors on one line."""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Self

from myoface.client.files import Transferred
from myoface.resources import Job, Progress

if TYPE_CHECKING:
    from solver.progress import Step

# The exit code where a verdict is bad; 1 says that there was no verdict.
BAD = 3

# Kinds of job that say what a file is worth, and what it is
JUDGED = {
    "check_scan": "scan",
    "check_markers": "take",
    "register_scan": "scan",
    "fit_markers": "take",
}

VERDICTS = {
    "good": ("green", "good"),
    "usable": ("yellow", "usable, with flaws"),
    "bad": ("red", "bad: it cannot be used"),
}

# Between two lines about one phase, where there is no terminal to show a live bar.
NEWS_SECONDS = 10.0
# Of a job that are done before it is said how long the rest takes.
LEAST_FRACTION = 0.1
LEAST_SECONDS = 3.0

# Characters that do something to a terminal, or to the order of what it shows (C0, C1, bidi), but
# for the end of a line; and halves of surrogate pairs, which cannot be written
HARMFUL = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Return a stranger's text as a terminal may see it: harmful characters as escapes."""
    return HARMFUL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class Painted(NamedTuple):
    """Text in a colour, or bold, where a terminal shows it."""

    text: str
    style: str


class Console:
    """A stream on which no text, wherever it is from, does more than be read.

    On a terminal its last line may be live: it is written over until it goes.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        self.stderr = stderr
        self._live = ""
        self._since = 0.0

    @property
    def stream(self) -> IO[str]:
        """Standard output or error, as it is at the moment."""
        return sys.stderr if self.stderr else sys.stdout

    @property
    def is_terminal(self) -> bool:
        """True where somebody sees what is written over."""
        return self.stream.isatty()

    def print(self, *parts: object) -> None:
        """Print texts one after the other, and end the line."""
        live = self._live
        self.show_live("")
        self.stream.write("".join(map(self._render, parts)) + "\n")
        self.stream.flush()
        self.show_live(live)

    def show_live(self, text: str) -> None:
        """Write the live line anew; on a terminal only."""
        if not text:
            self._since = 0.0  # the next bar is shown at once
        if not self.is_terminal or text == self._live:
            return
        shown = fit(printable(text), shutil.get_terminal_size().columns - 1) if text else ""
        self.stream.write("\r" + " " * cells(self._live) + "\r" + shown)
        self.stream.flush()
        self._live = shown

    def show_bar(self, title: str, fraction: float, words: str) -> None:
        """Show how far something is as the live line, ten times a second at most."""
        if fraction < 1.0 and time.monotonic() - self._since < 0.1:
            return
        self._since = time.monotonic()
        done = round(BAR_CELLS * min(max(fraction, 0.0), 1.0))
        bar = "#" * done + "." * (BAR_CELLS - done)
        self.show_live(f"{title} {bar} {words}".replace("\n", " "))

    def _render(self, part: object) -> str:
        text, style = part if isinstance(part, Painted) else (str(part), "")
        safe = printable(text)
        if not style or not self.is_terminal or "NO_COLOR" in os.environ or not TAKES_COLOURS:
            return safe
        return f"\x1b[{STYLES[style]}m{safe}\x1b[0m"


STYLES = {"red": 31, "green": 32, "yellow": 33, "bold": 1}
BAR_CELLS = 30
# The console of Windows before its Terminal shows the codes themselves
TAKES_COLOURS = os.name != "nt" or "WT_SESSION" in os.environ

out = Console()
err = Console(stderr=True)


def cells(text: str) -> int:
    """Return how wide a terminal shows a text."""
    wide = sum(unicodedata.east_asian_width(each) in "WF" for each in text)
    return len(text) + wide - sum(map(bool, map(unicodedata.combining, text)))


def fit(text: str, width: int) -> str:
    """Return as much of a text as ``width`` cells hold."""
    while cells(text) > width:
        text = text[:-1]
    return text


def complain(message: str) -> None:
    """Show an error."""
    err.print(Painted("error:", "red"), " ", message)


def confirm(question: str) -> None:
    """End the program unless somebody says yes."""
    out.stream.write(f"{printable(question)} [y/N] ")
    out.stream.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        complain("nothing was done")
        raise SystemExit(1)


def span(seconds: float | None) -> str:
    """Return a length of time: 12 s, 3 min 05 s, 2 h 10 min; empty for none."""
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02} min"
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"


def moment(at: datetime | None) -> str:
    """Return a moment to the minute, by this machine's clock; empty for none."""
    return "" if at is None else f"{at.astimezone():%Y-%m-%d %H:%M}"


def label_words(labels: Mapping[str, str]) -> str:
    """Return labels as a table shows them."""
    return ", ".join(f"{key}:{value}" for key, value in labels.items())


def show_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Show rows under column names, one line a row, however wide: an id stays whole."""
    lines = [list(columns), *(["" if cell is None else str(cell) for cell in row] for row in rows)]
    lines = [list(map(printable, line)) for line in lines]
    widths = [max(map(cells, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        padded = (
            text + " " * (width - cells(text)) for text, width in zip(line, widths, strict=True)
        )
        text = "  ".join(padded).rstrip()
        out.print(text if number else Painted(text, "bold"))


def show_outcome(kind: str, report: Mapping[str, Any], title: str | None = None) -> int:
    """Show what a job that judges came to; return its exit code, :data:`BAD` for a bad one.

    Those are checks, registrations and fits of takes: of other kinds it shows nothing. ``title``
    names the scan or take.
    """
    if kind not in JUDGED:
        return 0
    title = title or JUDGED[kind]
    if "verdict" not in report:
        if "coverage" in report:  # fits of takes had no verdict before
            show_registration(title, report)
        return 0
    findings = [*report.get("notices", ()), *report["findings"]]
    show_verdict(title, {**report, "findings": findings})
    return BAD if report["verdict"] == "bad" else 0


def show_verdict(title: str, check: Mapping[str, Any]) -> None:
    """Show the verdict of a check, and each finding with its advice."""
    style, words = VERDICTS[check["verdict"]]
    out.print(f"{title}: ", Painted(words, style))
    judged = check.get("judged", [])  # checks of before have none
    for each in judged:
        if each["about"] == "size" and each["judged"]:
            out.print(f"  {each['words']}")
    show_findings(check["findings"])
    for each in judged:
        if not each["judged"]:
            out.print(f"  not judged: {each['about']}: {each['words']}")


def show_registration(title: str, registration: Mapping[str, Any]) -> None:
    """Show how near a registered face is to its scan, and each finding with its advice."""
    words = f"registered, {registration['coverage']:.0%} of the face seen"
    if registration["mean_mm"] is not None:
        words += f", {registration['mean_mm']:.2f} mm off the scan on average"
    out.print(f"{title}: {words}")
    show_findings(registration["findings"])


def show_findings(findings: Iterable[Mapping[str, Any]]) -> None:
    """Show each finding with its advice."""
    for finding in findings:
        out.print(f"  - {finding['message']}")
        if finding.get("advice"):
            out.print(f"    {as_typed(finding['advice'])}")


def as_typed(words: str) -> str:
    """Return words of the API or a solver with what they say of options as it is typed here."""
    return words.replace("eye_distance_mm", "--eye-distance")


@contextmanager
def transfer_bar(title: str) -> Iterator[Transferred]:
    """Show a bar for bytes; yields a function of the bytes done and the bytes in all."""

    def show(done: int, total: int) -> None:
        million = 1e6
        words = f"{done / million:.1f}/{total / million:.1f} MB"
        if (seconds := time.monotonic() - began) > 0:
            words += f" {done / million / seconds:.1f} MB/s"
        out.show_bar(title, done / total if total else 1.0, words)

    began = time.monotonic()
    try:
        yield show
    finally:
        out.show_live("")


class JobDisplay:
    """Shows a job's phase, iteration and mean error while it runs, and times its phases.

    On a terminal it is a live bar; elsewhere (a log, CI) a line for every phase, and one for its
    news now and then. ``phases`` holds phase -> seconds afterwards.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.phases: dict[str, float] = {}
        self._phase = "queued"
        self._started: float | None = None  # when it told its first step
        self._since = self._began = time.monotonic()
        self._last_line = ("", 0.0)
        self._warned: set[str | None] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self._turn("end")
        out.show_live("")

    def watch(self, job: Job) -> None:
        """Take a job's news (a :data:`myoface.client.Watcher`)."""
        if job.state == "queued" or job.progress is None:
            self._started = None
            self._show(Progress(phase=job.state, fraction=0.0))
        else:
            self._show(job.progress)

    def __call__(self, step: Step, /) -> None:
        """Show a step of a computation in this process."""
        self._show(step)

    def _show(self, step: Step | Progress) -> None:
        if step.phase == "warning":
            if step.message not in self._warned:
                self._warned.add(step.message)
                out.print(f"{self.title}: warning: {step.message}")
            return
        words = summary(step)
        turns = step.phase != self._phase
        far = self._far(step.fraction)
        if turns:
            self._turn(step.phase)
        if not out.is_terminal:
            self._print(words, far, at_once=turns)
        passed = time.strftime("%H:%M:%S", time.gmtime(time.monotonic() - self._began))
        out.show_bar(self.title, step.fraction, f"{far or '0%'} {passed} {words}")

    def _far(self, fraction: float) -> str:
        """Return how much is done and about how long the rest takes; empty at the beginning."""
        now = time.monotonic()
        if not fraction:
            return ""
        self._started = self._started or now
        passed = now - self._started
        if fraction < LEAST_FRACTION or passed < LEAST_SECONDS or fraction >= 1.0:
            return f"{fraction:.0%}"
        return f"{fraction:.0%}, about {span(passed * (1.0 - fraction) / fraction)} left"

    def _print(self, words: str, far: str, *, at_once: bool) -> None:
        """Print a line, unless it says nothing new or the one before is not old yet."""
        before, moment = self._last_line
        now = time.monotonic()
        if at_once or (words != before and now - moment >= NEWS_SECONDS):
            self._last_line = (words, now)
            out.print(f"{self.title}: {words}", f" · {far}" if far else "")

    def _turn(self, phase: str) -> None:
        moment = time.monotonic()
        self.phases[self._phase] = self.phases.get(self._phase, 0.0) + moment - self._since
        self._phase = phase
        self._since = moment


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
