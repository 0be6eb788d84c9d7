"""``python -m tests.campaigns.faults``: plant faults one at a time, tell which suites notice."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from tests.campaigns.faults import catalogue, suites
from tests.campaigns.faults.catalogue import Fault, Selection
from tests.campaigns.faults.tree import NotPlantedError, Tree

MISSED = "missed"

console = Console(soft_wrap=True, markup=False, highlight=False)


class Campaign:
    """The faults of one tree; what is known of them is kept in ``record``.

    A test notices a fault if it fails with it and passes without.
    """

    def __init__(self, tree: Tree, scratch: Path, record: Path | None) -> None:
        self._tree = tree
        self._kernels = scratch / "kernels"
        self._fresh = scratch / "fresh-kernels"
        self._record = record
        kept = json.loads(record.read_text()) if record and record.exists() else {}
        self.clean: dict[str, Any] = kept.get("clean", {})
        self.faults: dict[str, Any] = kept.get("faults", {})
        self.wrong: dict[str, str] = {}

    def examine(self, fault: Fault) -> None:
        """Plant a fault and run its suites until one fails; what is known already stays."""
        if fault.name in self.faults:
            return
        try:
            places = self._tree.find(fault)
        except NotPlantedError as error:
            self.wrong[fault.name] = str(error)
            return
        kernels = self._fresh if any(place.is_compiled for place in places) else self._kernels
        shutil.rmtree(self._fresh, ignore_errors=True)
        row: dict[str, Any] = {"suite": MISSED, "test": "", "seconds": 0.0, "skipped": []}
        with self._tree.planted(places):
            for selection in fault.selections:
                found = suites.run(self._tree.path, selection, kernels)
                row["seconds"] = round(row["seconds"] + found.seconds, 1)
                if found.outcome == "failed":
                    row |= {"suite": selection.suite, "test": found.test}
                    break
                if found.outcome in ("skipped", "empty"):
                    row["skipped"].append(selection.text)
        if row["test"] and not suites.passes(self._tree.path, row["test"], self._kernels):
            self.wrong[fault.name] = f"{row['test']} fails without it, too"
            return
        row["file"] = str(places[0].path.relative_to(self._tree.path))
        self.faults[fault.name] = row
        self._keep()
        console.print(f"{fault.name}: {row['suite']} {row['test']} ({row['seconds']} s)")

    def check_clean(self, selections: dict[str, Selection]) -> None:
        """Run all parts of suites that are asked for where no fault is planted."""
        for text, selection in selections.items():
            if text in self.clean:
                continue
            found = suites.run(self._tree.path, selection, self._kernels)
            self.clean[text] = asdict(found)
            self._keep()
            console.print(f"{text}: {found.outcome} {found.test} ({found.seconds} s)")
            if found.outcome == "failed":
                self.wrong[text] = f"{found.test} fails without any fault"

    def _keep(self) -> None:
        if self._record:
            content = {"clean": self.clean, "faults": self.faults}
            self._record.write_text(json.dumps(content, indent=1) + "\n")


def table(faults: list[Fault], found: dict[str, Any]) -> str:
    """Return what was found as Markdown."""
    lines = ["| fault | room | what is wrong | suite that fails | test |", "|---|---|---|---|---|"]
    for fault in faults:
        row = found.get(fault.name, {"suite": "not planted", "test": "", "skipped": []})
        suite = row["suite"]
        if suite == MISSED and row["skipped"]:
            suite += f" (skipped: {', '.join(row['skipped'])})"
        test = row["test"].rsplit("/", 1)[-1]
        lines.append(f"| {fault.name} | {fault.room} | {fault.wrong} | {suite} | {test} |")
    counts = Counter(row["suite"] for row in found.values())
    lines += ["", ", ".join(f"{suite} {count}" for suite, count in counts.most_common())]
    return "\n".join(lines)


def main() -> None:
    """Plant the faults and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.faults", description=__doc__)
    parser.add_argument("--root", type=Path, default=Path.cwd(), help="the tree under test")
    parser.add_argument("--only", nargs="+", default=[], help="faults whose names hold these words")
    parser.add_argument("--json", type=Path, help="where findings are kept: a later run goes on")
    parser.add_argument("--find", action="store_true", help="only look whether all can be planted")
    parser.add_argument("--clean", action="store_true", help="first run all parts without a fault")
    parser.add_argument("--again", action="store_true", help="also those that are known")
    scratch = Path(tempfile.gettempdir()) / "myoface-faults"
    parser.add_argument("--scratch", type=Path, default=scratch, help="where the copy is kept")
    given = parser.parse_args()
    faults = catalogue.load(given.only)
    given.scratch.mkdir(parents=True, exist_ok=True)
    tree = Tree(given.root.resolve(), given.scratch.resolve())
    campaign = Campaign(tree, given.scratch.resolve(), given.json)
    if given.find:
        for fault in faults:
            try:
                console.print(f"{fault.name}: {tree.find(fault)[0].path.relative_to(tree.path)}")
            except NotPlantedError as error:
                campaign.wrong[fault.name] = str(error)
    else:
        if given.clean:
            campaign.check_clean({part.text: part for each in faults for part in each.selections})
        for fault in faults:
            if given.again:
                campaign.faults.pop(fault.name, None)
            campaign.examine(fault)
        console.print(table(faults, campaign.faults))
    for name, why in campaign.wrong.items():
        console.print(f"not planted: {name}: {why}")
    if campaign.wrong:
        sys.exit(1)


if __name__ == "__main__":
    main()
