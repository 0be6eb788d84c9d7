"""Follow a how-to to the letter in a copy of the tree: its files, its changes, its commands."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
STEP = re.compile(r"^(Create|Change) `([^`]+)`:$|^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WORD = re.compile(r"\w+|\W")


@dataclass
class Followed:
    """A tree in which a page was followed: files it touched, and the code of its other blocks."""

    tree: Path
    created: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    code: list[str] = field(default_factory=list)

    def test(self, *arguments: str) -> str:
        """Run tests in the tree, with a place of their own for temporary files."""
        # pytest would else tidy up what others left in the common one, and fail when it cannot
        place = self.tree.with_name(f"{self.tree.name}-tests")
        return self.run("-m", "pytest", "-q", f"--basetemp={place}", *arguments)

    def run(self, *arguments: str) -> str:
        """Run Python in the tree and return what it prints."""
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=self.tree,
            env=os.environ | {"PYTHONPATH": str(self.tree)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout

    def check_style(self) -> None:
        """Check what was created and changed as `make check` does."""
        # a list that has grown since the page was written may be too long for its line
        self.run("-m", "ruff", "format", "-q", *self.changed)
        for command in (["check", "-q"], ["format", "--check", "-q"]):
            self.run("-m", "ruff", *command, *self.created, *self.changed)


def page(name: str) -> str:
    """Return the text of a how-to."""
    return (ROOT / "docs" / "develop" / f"{name}.md").read_text(encoding="utf-8")


def copy_tree(tree: Path, *parts: str) -> None:
    """Copy files and folders of the project, with the kernels compiled so far."""
    for part in ("pyproject.toml", *parts):
        (tree / part).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, tree / part)
        else:
            shutil.copy2(ROOT / part, tree / part)


def follow(text: str, tree: Path) -> Followed:
    """Do what a page says in a tree.

    "Create" takes the next block for a file's text, "Change" all diffs that follow. Of commands
    all are run but the tests.
    """
    done = Followed(tree)
    verb = ""
    path = ""
    for step in STEP.finditer(text):
        if step[1]:
            verb = step[1]
            path = step[2]
            (done.created if verb == "Create" else done.changed).append(path)
        elif verb == "Create" and step[3] == "python":
            assert not (tree / path).exists(), path
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            (tree / path).write_text(step[4], encoding="utf-8")
            verb = ""
        elif verb == "Change" and step[3] == "diff":
            content = (tree / path).read_text(encoding="utf-8")
            (tree / path).write_text(apply(step[4].splitlines(), content), encoding="utf-8")
        elif step[3] == "python":
            done.code.append(step[4])
        elif step[3] == "sh" and "pytest" not in step[4]:
            subprocess.run(["sh", "-ec", step[4]], cwd=tree, check=True)
    return done


def apply(diff: list[str], content: str) -> str:
    """Return a file's content with the lines of a diff without line numbers."""
    before = "".join(f"{line[1:]}\n" for line in diff if line[0] in " -")
    after = "".join(f"{line[1:]}\n" for line in diff if line[0] in " +")
    if before not in content and [line[0] for line in diff] == ["-", "+"]:
        return _grow(content, diff[0][1:], diff[1][1:])
    assert content.count(before) == 1, f"not there once:\n{before}"
    return content.replace(before, after)


def _grow(content: str, old: str, new: str) -> str:
    """Return a content with the words that ``new`` adds to ``old`` in the line that has old's.

    Its list may be longer than the page says, by what was added to it since in the same way.
    """
    left = WORD.findall(old)
    [found] = re.finditer("(.*?)".join(map(re.escape, left)), content)
    line = ""
    others = ["", *found.groups()]
    for word in WORD.findall(new):
        if left and word == left[0]:
            line += others.pop(0)
            left.pop(0)
        line += word
    assert not left, f"{new!r} does more than add to {old!r}"
    return content[: found.start()] + line + content[found.end() :]
