"""Changes of a configuration file by a command: the file is replaced only by a valid one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config, ConfigError
from uavlinkd.system.folders import sync_folder, write_new
from uavlinkd.system.terminal import CommandError


@contextmanager
def trial(path: Path, text: str, folder: Path | None) -> Iterator[tuple[Path, Config]]:
    """A file beside the configuration, with this text, and its configuration. Nothing else changes.

    ``folder``: that of a service's keys. Raises ConfigError, about the configuration, if the text is not valid.
    """
    new = path.with_name(f".{path.name}.trial")
    try:
        write_new(new, text.encode())
        shutil.copymode(path, new)
        keep_owner(path, new)
        config = load_config(new, environ_of(folder))
        yield new, config
    except ConfigError as error:
        raise ConfigError(tuple(one._replace(file=str(path)) for one in error.problems)) from None
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        with suppress(OSError):
            new.unlink()


def replace_valid(path: Path, text: str, folder: Path | None) -> Config:
    """Replace the file, if the text is valid. Returns its configuration. Raises ConfigError or CommandError."""
    with trial(path, text, folder) as (new, config):
        new.replace(path)
        sync_folder(path.parent)
    return config


def environ_of(folder: Path | None) -> Mapping[str, str]:
    """The environment in which a configuration is read: with the folder of a service's keys, if one is named."""
    return os.environ if folder is None else {keys.CREDENTIALS: str(folder.absolute())}


def keep_owner(path: Path, new: Path) -> None:
    """Give a new file the owner of another: with sudo it would belong to root, and the daemon could not read it."""
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        status = path.stat()
        os.chown(new, status.st_uid, status.st_gid)
