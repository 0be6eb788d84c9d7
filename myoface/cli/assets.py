"""Commands that fetch anatomy and face models of others."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import httpx

from myoface.assets.catalogue import CATALOGUE, Name, PublicAsset
from myoface.assets.fetch import fetch as fetch_asset
from myoface.assets.fetch import unpack
from myoface.cli.commands import Group, Option, UsageError
from myoface.cli.console import confirm, out, show_table, transfer_bar
from myoface.errors import ApiError
from solver.cache import cache_path

assets = Group("Anatomy and face models of others.")

TIMEOUT = httpx.Timeout(30.0, connect=10.0)


@assets.command("list")
def list_assets() -> None:
    """List what can be fetched, from where."""
    rows = [(asset.name, asset.title, asset.url) for asset in CATALOGUE.values()]
    show_table(("name", "what", "address"), rows)


@assets.command()
def fetch(
    name: Name,
    to: Annotated[
        Path | None,
        Option(
            file_okay=False,
            help="folder; default: one of that name here, of the landmarker the cache",
        ),
    ] = None,
    mirror: Annotated[str | None, Option(help="address of a folder that holds the archive")] = None,
    file: Annotated[
        Path | None, Option(exists=True, dir_okay=False, help="a copy that you have")
    ] = None,
    sha256: Annotated[str | None, Option(help="what the archive must be")] = None,
    accept_licence: Annotated[
        bool, Option("--accept-licence", help="do not ask about the licence")
    ] = False,
) -> None:
    """Fetch a model from its owner after showing its licence; checked, and resumed if it broke."""
    if mirror is not None and file is not None:
        raise UsageError("--mirror and --file exclude one another")
    asset = CATALOGUE[name]
    _agree(asset, accept_licence)
    is_found = asset.is_cached and to is None
    folder = cache_path() / name if is_found else to or Path(name)
    try:
        with (
            httpx.Client(follow_redirects=True, timeout=TIMEOUT) as http,
            transfer_bar(asset.file) as bar,
        ):
            archive = fetch_asset(
                http, asset, folder, mirror=mirror, file=file, sha256=sha256, progress=bar
            )
    except ApiError as error:
        detail = f"{error.problem['detail']}; --mirror or --file take it from elsewhere"
        raise ApiError({**error.problem, "detail": detail}) from error
    place = unpack(asset, archive, cache_path() if is_found else folder)
    if is_found:
        out.print(f"{place}\nIt is found there: nothing else is to be set")
    else:
        out.print(f"{archive}\nUse it: {asset.use.format(place=place)}")


def _agree(asset: PublicAsset, accepted: bool) -> None:
    out.print(asset.licence)
    if accepted:
        return
    if not sys.stdin.isatty():
        raise UsageError("nobody can answer here: accept with --accept-licence")
    confirm("Do you accept this licence?")
