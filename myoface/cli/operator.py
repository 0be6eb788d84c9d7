"""Commands that need a checkout: known here by name, loaded when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from myoface.cli.commands import Runnable
from myoface.errors import StackError


@dataclass(frozen=True)
class OperatorCommand:
    """A command whose code is not in the wheel."""

    name: str
    help: str

    def load(self) -> Runnable:
        """Return the command itself.

        Raises
        ------
        StackError
            If it cannot be loaded here.
        """
        try:
            from myoface.cli import checkout
        except ModuleNotFoundError as error:
            raise self._refusal(error) from error
        checkout.configure_logs()
        return checkout.MEMBERS[self.name]

    def run(self, words: Sequence[str], title: str) -> None:
        """Do what ``words`` say."""
        member = self.load()
        from myoface.cli import checkout

        try:
            with checkout.told_faults():
                member.run(words, title)
        except ModuleNotFoundError as error:  # commands load their parts when they run
            raise self._refusal(error) from error

    def _refusal(self, error: ModuleNotFoundError) -> StackError:
        return StackError(
            f"`myoface {self.name}` needs Linux and a checkout of Myoface, after `make setup` in "
            f"it (there is no module {error.name!r} here)"
        )


HELP = {
    "up": "Run the service on this machine.",
    "demo": "Fit a face of the demonstration, from its scans to its rig.",
    "doctor": "Check this machine, and the service's data.",
    "admin-key": "Make a key that may do everything.",
    "backup": "Copy the database and every file into a folder.",
    "restore": "Fill an empty service from a backup.",
    "transfer": "Play a video of a face by a rig.",
    "tenants": "Tenants: customers who see nothing of one another.",
    "template": "Make and check template anatomies.",
    "assets": "Anatomy and face models of others.",
    "markers": "Markers on a face: check takes, bind them to a person.",
    "solve": "Solve here, without a service.",
}
OPERATOR: Mapping[str, Runnable] = {
    name: OperatorCommand(name, f"{words} (Linux, from a checkout)") for name, words in HELP.items()
}
