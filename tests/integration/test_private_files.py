"""What the service writes is nobody else's to read, and its key is in no log."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import httpx

from service.settings import Settings
from tests.servers.production import Production
from tests.service_client import ROOT, STANDIN, Studio, eventually

COMMAND = "import sys; from myoface.cli import main; sys.argv[0] = 'myoface'; main()"


def test_up_lets_nobody_else_read_and_logs_no_key(tmp_path: Path, parts: Production | None) -> None:
    data = tmp_path / "data"
    backup = tmp_path / "backup"
    told = tmp_path / "told"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MYOFACE_JOBS": STANDIN["jobs"]}

    def wide() -> None:
        os.umask(0o000)

    with told.open("wb") as output:
        up = subprocess.Popen(
            [sys.executable, "-c", COMMAND, "up", "--port", "0", "--data", str(data)],
            env=environment,
            stdout=output,
            stderr=output,
            preexec_fn=wide,
        )
    try:
        eventually(lambda: "Its page" in told.read_text(), seconds=60)
        settings = Settings(data_dir=data)
        key = settings.admin_key.read_text()
        lines = told.read_text()
        url = next(word for word in lines.split() if word.startswith("http")).rstrip(".")
        with httpx.Client(base_url=url, timeout=30) as http:
            Studio(http, key).modelled()
        backing = [sys.executable, "-c", COMMAND, "backup", str(backup), "--data", str(data)]
        subprocess.run(backing, env=environment, check=True, preexec_fn=wide)
    finally:
        up.send_signal(signal.SIGTERM)
        up.wait(30)
    found = [*tmp_path.glob("data/**/*"), *tmp_path.glob("backup/**/*"), data, backup]
    modes = {path: path.stat().st_mode for path in found if not path.is_symlink()}
    assert [path for path, mode in modes.items() if mode & 0o077] == []
    stored = [mode for path, mode in modes.items() if len(path.name) == 64]
    if parts is None:
        assert stored
    assert {stat.S_IMODE(mode) for mode in stored} <= {0o400}
    written = [told, *(data / "logs").iterdir()]
    assert [path for path in written if key in path.read_text(errors="replace")] == []
    assert str(settings.admin_key) in lines
