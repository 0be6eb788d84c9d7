"""Whose certificates a client takes for the service's."""

from __future__ import annotations

import os
import ssl
from pathlib import Path

from myoface.errors import ApiError

VARIABLE = "MYOFACE_CA"
NO_AUTHORITY = "client.ca"


def trust(ca: Path | str | None) -> ssl.SSLContext | bool:
    """Return what httpx verifies a service's certificate with.

    That is the authority in the PEM file ``ca``, or in the one that ``MYOFACE_CA`` names, and no
    other; without either the public authorities.

    Raises
    ------
    ApiError
        ``client.ca`` if the file holds no certificate that can be read.
    """
    path = ca or os.environ.get(VARIABLE)
    if not path:
        return True
    try:
        return ssl.create_default_context(cafile=path)
    except OSError as error:  # ssl.SSLError is one
        reason = error.strerror or str(error)
        detail = f"no authority to verify the service with: {reason}"
        raise ApiError({"code": NO_AUTHORITY, "detail": detail, "file": str(path)}) from error
