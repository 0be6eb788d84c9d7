"""Dumps of the database: SQLite's by ``VACUUM INTO``, PostgreSQL's by ``pg_dump``."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import URL, MetaData, create_engine, inspect, text
from sqlalchemy.orm import Session

from myoface.errors import StackError
from service.store.database import UNFINISHED, Database
from service.store.durable import move_durably

# `COPY public.alembic_version (version_num) FROM stdin;` and its one row, as pg_restore prints them
REVISION_ROW = re.compile(r"^COPY [\w.]*alembic_version .*\n(\w+)$", re.MULTILINE)


@contextmanager
def dump_of(database: Database, target: Path) -> Iterator[Session]:
    """Dump the database to ``target``; gives a session that sees just what was dumped.

    Raises
    ------
    StackError
        If there is no database, or it or the dump is not whole.
    """
    fresh = target.with_name(f"{target.name}.new")
    fresh.unlink(missing_ok=True)
    if database.is_sqlite:
        source = Path(str(database.url.database))
        if not source.exists():
            raise StackError(f"there is no database at {source}: is --data the service's folder?")
        try:
            with closing(sqlite3.connect(source)) as connection:
                connection.execute("VACUUM INTO ?", [str(fresh)])
            check_sqlite(fresh)
        except sqlite3.Error as error:
            raise StackError(f"the database could not be dumped: {error}") from error
        fresh.chmod(0o600)
        move_durably(fresh, target)
        copy = create_engine(f"sqlite:///{_reading(target)}&uri=true")
        try:
            with Session(copy) as session:
                yield session
        finally:
            copy.dispose()
        return
    frozen = database.engine.execution_options(isolation_level="REPEATABLE READ")
    with Session(frozen) as session:
        name = session.scalar(text("SELECT pg_export_snapshot()"))
        run_tool("pg_dump", "-Fc", f"--snapshot={name}", f"--file={fresh}", url=database.url)
        fresh.chmod(0o600)
        move_durably(fresh, target)
        yield session


def check_sqlite(path: Path) -> None:
    """Read all of a SQLite database.

    Raises
    ------
    sqlite3.Error
        If it is damaged.
    """
    with closing(sqlite3.connect(_reading(path), uri=True)) as connection:
        found = connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if found != "ok":
        raise sqlite3.DatabaseError(found)


def _reading(path: Path) -> str:
    """Return a dump's address for SQLite, read-only: nothing is written to it or beside it."""
    return f"file:{quote(str(path))}?mode=ro&immutable=1"


def check_postgresql(dump: Path) -> None:
    """Read all of a PostgreSQL dump.

    Raises
    ------
    StackError
        If it is damaged.
    """
    run_tool("pg_restore", "--file=/dev/null", str(dump))


def dumped_revision(dump: Path, name: str) -> str | None:
    """Return the revision of the tables in a dump; None: there are no tables."""
    if name == "sqlite":
        with closing(sqlite3.connect(_reading(dump), uri=True)) as connection:
            try:
                row = connection.execute("SELECT version_num FROM alembic_version").fetchone()
            except sqlite3.OperationalError:
                return None
        return str(row[0]) if row else None
    only = ("--data-only", "--table=alembic_version", "--file=-")
    row = REVISION_ROW.search(run_tool("pg_restore", *only, str(dump)))
    return row[1] if row else None


def is_empty(database: Database) -> bool:
    """Return whether a restore may fill a database: nothing is there, or an unfinished restore."""
    path = Path(str(database.url.database))
    if database.is_sqlite and not path.exists():
        return True
    tables = inspect(database.engine).get_table_names()
    return not tables or UNFINISHED in tables


def load(dump: Path, database: Database, then: Callable[[Database], None]) -> None:
    """Fill an empty database with a dump, and do ``then`` to it, all of that or nothing."""
    if database.is_sqlite:
        database.close()  # what is open would write into the file that goes
        _load_sqlite(dump, Path(str(database.url.database)), then)
    else:
        _load_postgresql(dump, database, then)


def _load_sqlite(dump: Path, target: Path, then: Callable[[Database], None]) -> None:
    """Finish a copy under another name, then give it its own."""
    fresh = target.with_name(f"{target.name}.restoring")
    _remove_sqlite(fresh)
    shutil.copyfile(dump, fresh)
    fresh.chmod(0o600)
    copy = Database(f"sqlite:///{fresh}")
    try:
        then(copy)
        copy.forget_deleted()
    except BaseException:
        copy.close()
        _remove_sqlite(fresh)
        raise
    copy.close()
    for name in (f"{fresh.name}-wal", f"{fresh.name}-shm", f"{fresh.name}.migrate"):
        fresh.with_name(name).unlink(missing_ok=True)
    _remove_sqlite(target)
    move_durably(fresh, target)


def _remove_sqlite(path: Path) -> None:
    for ending in ("", "-wal", "-shm", ".migrate"):
        path.with_name(path.name + ending).unlink(missing_ok=True)


def _load_postgresql(dump: Path, database: Database, then: Callable[[Database], None]) -> None:
    """Mark the database as unfinished, so that a restore that was interrupted begins anew."""
    found = MetaData()
    with database.engine.begin() as connection:
        found.reflect(connection)
        found.drop_all(connection)
        connection.execute(text(f"CREATE TABLE {UNFINISHED} ()"))
    whole = ("--no-owner", "--exit-on-error", "--single-transaction")
    run_tool("pg_restore", *whole, str(dump), url=database.url)
    then(database)
    with database.engine.begin() as connection:
        connection.execute(text(f"DROP TABLE {UNFINISHED}"))


def run_tool(name: str, *words: str, url: URL | None = None) -> str:
    """Run ``pg_dump`` or ``pg_restore``, on a database if its ``url`` is given.

    The password is not on the command line. Returns what it printed.

    Raises
    ------
    StackError
        If it is not installed or fails.
    """
    program = shutil.which(name)
    if program is None:
        raise StackError(f"{name} is not installed: apt-get install postgresql-client")
    command = [program, *words]
    environment = dict(os.environ)
    if url is not None:
        where = (url.username, None, url.host, url.port, url.database, url.query)
        plain = URL.create("postgresql", *where).render_as_string()
        command.append(f"--dbname={plain}")
        environment["PGPASSWORD"] = url.password or ""
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StackError(f"{name} failed: {done.stderr.strip()}")
    return done.stdout
