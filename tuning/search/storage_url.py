"""The parts of a storage's URL that may be shown: scheme, host and database, not user, password or options."""

from __future__ import annotations

import re
from urllib.parse import unquote_plus

HIDDEN = "***"
DATABASES = ("postgresql", "postgres", "mysql", "mariadb", "sqlite", "oracle", "mssql", "redis", "grpc")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*")
_PLACE = re.compile(r"(?P<host>[\w.-]*|\[[0-9A-Fa-f:.]+\])(?P<port>:\d+)?(?P<database>/[^:@]*)?", re.ASCII)
_MARKS = re.compile(r"[:/@?#&=;,\s]+")
_MISSPELT = re.compile(rf"({'|'.join(DATABASES)})(\+\w+)?:(?!//)", re.IGNORECASE)


def public_url(storage: str) -> str:
    """A storage for messages: a path as it is, of a URL scheme, host, port and database.

    For an ambiguous URL, such as one with a question mark in the password, only the scheme is shown.
    """
    scheme, separator, rest = storage.partition("://")
    if not separator:
        misspelt = _MISSPELT.match(storage)
        return storage if misspelt is None else f"{misspelt[0]}{HIDDEN}"
    if not _SCHEME.fullmatch(scheme):
        return HIDDEN
    place = _place(rest)
    return f"{scheme}://{HIDDEN if place is None else place}"


def is_misspelt(storage: str) -> bool:
    """Whether this is a database's URL except for its slashes, and not a path."""
    return bool(_MISSPELT.match(storage))


def _place(rest: str) -> str | None:
    """Host, port and database of what follows a scheme, None where it is not sure which part they are."""
    if rest.startswith("/"):  # no host, and so no user
        return re.split(r"[?#]", rest, maxsplit=1)[0]
    before, at, after = rest.rpartition("@")
    if at and re.search(r"[?#]", before):
        return None
    place = re.split(r"[?#]", after, maxsplit=1)[0]
    return place if _PLACE.fullmatch(place) else None


def without_secrets(text: str, storage: str) -> str:
    """A message of a database or its driver without the hidden parts of the storage's URL."""
    shown = public_url(storage)
    if shown == storage:
        return text
    rest = storage.partition("://")[2]
    if rest.startswith("/"):
        login, place = "", rest
    elif shown.endswith(HIDDEN):  # any part may be a password
        place = storage if shown == HIDDEN else storage.partition(":")[2]
        login = f":{place}"
    else:
        login, _, place = rest.rpartition("@")
    options = [option.partition("=")[2] for option in re.split(r"[?#&;]", place)[1:]]
    secrets = {part for one in (login.partition(":")[2], *options) for part in (one, unquote_plus(one))}
    # A driver that reads the URL in another way may name a part of a password, as that before its slash.
    secrets |= {word for secret in secrets for word in _MARKS.split(secret)} - {*_MARKS.split(shown)}
    text = text.replace(storage, shown)
    for secret in sorted(secrets - {""}, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(secret)}(?!\w)", HIDDEN, text)
    return text


def first_line(error: BaseException) -> str:
    """The first line of an error, or its class's name."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
