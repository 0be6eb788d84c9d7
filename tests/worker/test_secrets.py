"""What a solver that was taken over finds of its worker's."""

from __future__ import annotations

import subprocess
import sys

from worker.process import _harmless

SECRETS = {
    "MYOFACE_SECRET_KEY": "x",
    "MYOFACE_DATABASE_URL": "postgresql://myoface:x@postgres/myoface",
    "AWS_SECRET_ACCESS_KEY": "x",
    "OTEL_EXPORTER_OTLP_HEADERS": "x",
    "PGPASSWORD": "x",
    "REDISCLI_AUTH": "x",
    "GOOGLE_APPLICATION_CREDENTIALS": "x",
    "GITHUB_TOKEN": "x",
    "SSH_AUTH_SOCK": "x",
}
NEEDED = {"PATH": "/bin", "HOME": "/root", "LC_ALL": "C", "NUMBA_CACHE_DIR": "/tmp/numba"}


def test_a_solver_is_given_what_it_needs_and_no_more() -> None:
    assert _harmless(SECRETS | NEEDED) == NEEDED


def test_the_memory_of_api_and_workers_is_their_own() -> None:
    code = (
        "import ctypes; from service.process import hide_memory; hide_memory();"
        "print(ctypes.CDLL(None).prctl(3, 0, 0, 0, 0))"  # PR_GET_DUMPABLE
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"
