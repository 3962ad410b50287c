"""The certificate of a relay that is reached by TLS. Members do not check it: TLS carries, the links protect."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from uavlinkd.config.keys import find_secret_file
from uavlinkd.config.model import HttpsServer

if TYPE_CHECKING:
    from ssl import SSLContext

_MAKE = (
    "`openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 -subj /CN=uavlinkd"
    " -keyout tls.key -out tls.crt` makes both"
)


class TlsFileError(ValueError):
    """A certificate or its key cannot be used. The message has a remedy."""


def find_tls_files(server: HttpsServer, folder: Path, environ: Mapping[str, str]) -> HttpsServer:
    """The same with the paths of its files, which are systemd credentials if there are such.

    Raises TlsFileError if they cannot be used.
    """
    certificate, key = (find_secret_file(str(name), folder, environ)[0] for name in (server.certificate, server.key))
    load_tls(certificate, key)
    return replace(server, certificate=certificate, key=key)


def load_tls(certificate: Path, key: Path) -> SSLContext:
    """What a server of TLS needs. Raises TlsFileError if the files cannot be used."""
    from uavlinkd.tls.channel import server_context  # noqa: PLC0415  only if configured

    for path in (certificate, key):
        if not os.path.isfile(path):  # opening a pipe would wait for its writer
            raise TlsFileError(f"{path} is not a file that this user sees: {_MAKE}")
    try:
        return server_context(str(certificate), str(key))
    except PermissionError:
        text = f"{certificate} or {key} cannot be read: the daemon's user has to read both"
    except (OSError, ValueError) as error:
        if getattr(error, "reason", "") == "KEY_VALUES_MISMATCH":
            text = f"key {key} is not that of the certificate {certificate}: write the two that were made together"
        else:
            text = f"{certificate} and {key} are not a certificate and its key, in PEM without a passphrase: {_MAKE}"
    raise TlsFileError(text)
