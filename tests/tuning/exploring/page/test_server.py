"""Who gets an answer from the server of the page; where `tuning.explore` begins and what it refuses."""

import asyncio
import html
import http.client
import os
import re
import socket
import stat
import subprocess
import sys
import urllib.error
import urllib.request
import webbrowser
from threading import Thread

import pytest

pytest.importorskip("bokeh")

from bokeh.models import ColumnDataSource, Div
from bokeh.util.token import generate_jwt_token
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

import tuning
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tuning.api import explore
from tuning.api.explore import _forward
from tuning.exploring.page import session
from tuning.exploring.page.session import LOOPBACK, Server

SCRIPT = "static/js/bokeh.min.js"


def page(document):
    """A page, which need not be that of a bench."""
    document.add_root(Div(text="hello"))
    document.add_root(ColumnDataSource())


@pytest.fixture(scope="module")
def server():
    made = Server(page, ends_when_left=False).start()
    yield made
    made.stop()


def token_of(server):
    return server.url.rstrip("/").rpartition("/")[2]


def asked(server, path, **headers):
    """Status, headers and body of an answer."""
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=30)
    given = {"Host": f"{LOOPBACK}:{server.port}"} | {name.replace("_", "-"): one for name, one in headers.items()}
    connection.putrequest("GET", path, skip_host=True)
    for name, value in given.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def socket_status(server, path, **headers):
    """The status with which a websocket is opened, 101, or refused."""

    async def opened():
        url = f"ws://{LOOPBACK}:{server.port}{path}"
        request = HTTPRequest(url, headers={name.replace("_", "-"): one for name, one in headers.items()})
        try:
            found = await websocket_connect(request, subprotocols=["bokeh", generate_jwt_token("x")])
        except HTTPClientError as error:
            return error.code
        found.close()
        return 101

    return asyncio.run(opened())


def test_whoever_has_the_token_gets_the_page_and_its_scripts(server):
    token = token_of(server)
    status, headers, body = asked(server, f"/{token}/")
    assert status == 200 and b"bokeh" in body and headers["Referrer-Policy"] == "no-referrer"
    assert asked(server, f"/{token}/{SCRIPT}")[0] == 200
    assert asked(server, f"/{token}/", Host=f"localhost:{server.port}")[0] == 200


def test_without_the_token_nothing_is_answered_and_all_refusals_are_the_same(server):
    token = token_of(server)
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    paths = ["/", f"/{SCRIPT}", "/ws", "/autoload.js", "/metadata", "/favicon.ico"]
    paths += [f"/{wrong}/", f"/{wrong}/{SCRIPT}"]
    paths += [f"/{token[:-1]}/", f"/{token}x/", f"/{token.lower()}/", f"/x/{token}/", f"/?token={token}", "//"]
    found = [asked(server, path) for path in paths]
    assert {status for status, _, _ in found} == {404}
    assert len({body for _, _, body in found}) == 1 and token.encode() not in found[0][2]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1", "[::1]:80", ""])
def test_another_name_that_leads_here_is_refused(server, host):
    assert asked(server, f"/{token_of(server)}/", Host=host)[0] == 404


def test_pages_of_others_and_paths_out_of_the_folder_are_refused_even_with_the_token(server):
    path = f"/{token_of(server)}/"
    assert asked(server, path, Origin="http://evil.example")[0] == 404
    assert asked(server, path, Origin="null")[0] == 404
    assert asked(server, path, Origin=f"https://{LOOPBACK}:{server.port}")[0] == 404
    assert asked(server, path, Origin=f"http://{LOOPBACK}:{server.port}")[0] == 200
    for path in ("static/../../../../../../etc/passwd", "static/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd"):
        assert asked(server, f"/{token_of(server)}/{path}")[0] in (403, 404)


def test_a_websocket_needs_token_and_origin(server):
    token, ours = token_of(server), f"http://{LOOPBACK}:{server.port}"
    assert socket_status(server, f"/{token}/ws", Origin=ours) == 101
    assert socket_status(server, f"/{token}/ws") == 404
    assert socket_status(server, f"/{token}/ws", Origin="http://evil.example") == 404
    assert socket_status(server, f"/{token[:-1]}/ws", Origin=ours) == 404
    assert socket_status(server, "/ws", Origin=ours) == 404


def test_it_listens_on_the_loopback_address_alone_and_tokens_are_long_and_new():
    one, other = Server(page), Server(page)
    assert {each.getsockname()[0] for each in one._sockets} == {LOOPBACK}
    assert token_of(one) != token_of(other) and len(token_of(one)) >= 43  # 256 bits
    for each in (*one._sockets, *other._sockets):
        each.close()


@pytest.mark.slow
def test_it_ends_when_the_last_page_was_left(monkeypatch):
    monkeypatch.setattr(session, "LEFT_FOR", 0.2)
    made = Server(page)
    thread = Thread(target=made.run, daemon=True)
    thread.start()
    assert made._started.wait(30)

    async def visit():
        import json
        import re

        text = (await asyncio.to_thread(asked, made, f"/{token_of(made)}/"))[2].decode()
        token = json.loads(re.search(r'"token":("[^"]+")', text)[1])
        origin = {"Origin": f"http://{LOOPBACK}:{made.port}"}
        url = f"ws://{LOOPBACK}:{made.port}/{token_of(made)}/ws"
        found = await websocket_connect(HTTPRequest(url, headers=origin), subprotocols=["bokeh", token])
        await found.read_message()  # its ACK: now the page is open
        await asyncio.sleep(1.5)
        assert thread.is_alive()
        found.close()

    asyncio.run(visit())
    thread.join(60)
    assert not thread.is_alive()
    with pytest.raises(OSError):
        socket.create_connection((LOOPBACK, made.port), timeout=5)


def test_a_port_in_use_is_named_with_a_way_out(server):
    with pytest.raises(ValueError, match=f"port must be free, or 0 for one .*, but {server.port} is not: Address"):
        Server(page, port=server.port)


def test_hardly_anything_is_read_before_the_token(server):
    """A body of 4 MB without a token was read whole, up to 98 MB a connection."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        head = f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: {2**22}\r\n\r\n"
        connection.sendall(head.encode())
        answer = connection.recv(1000)
    assert not answer or answer.startswith(b"HTTP/1.1 4")


def test_folders_of_killed_explorers_are_removed_at_the_next_start(tmp_path, monkeypatch):
    monkeypatch.setattr(explore.tempfile, "gettempdir", lambda: str(tmp_path))
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = f"thruster-explore-{dead.pid}-x", f"thruster-explore-{os.getpid()}-x", "thruster-explore-abc", "other"
    for name in names:
        (tmp_path / name).mkdir(mode=0o700)
    explore._remove_left_over()
    assert {one.name for one in tmp_path.iterdir()} == set(names[1:])


def test_a_notebook_shows_the_page_in_a_frame_until_it_is_closed():
    bench = tuning.explore(LinearProblem(n=2, m=1), filter="kf", seeds=2)
    shown = bench._repr_html_()
    url = html.unescape(re.search(r'src="([^"]+)"', shown)[1])
    assert url == bench.url and "kf on linear-2" in shown
    with urllib.request.urlopen(url, timeout=60) as answer:
        assert answer.status == 200
    bench.close()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=30)


def test_the_function_is_still_there_when_its_room_was_imported():
    import tuning.exploring.bench  # noqa: F401

    assert tuning.explore is tuning.explore and callable(tuning.explore)


def test_own_numbers_are_where_one_starts():
    problem = LinearProblem(n=2, m=1)
    bench = tuning.explore(problem, problem.model(process_noise_cov=[0.3, 0.4])).bench
    assert bench.filter == "ekf" and bench.start["Q11"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (dict(problem="outliers", filter="open-loop"), "filter must be one that has a number to change"),
        (dict(problem="outliers", seeds=0), "seeds must be"),
        (dict(problem="tuned.json", filter="ekf"), "give either a tuned file or a filter"),
    ],
    ids=str,
)
def test_what_cannot_be_explored_is_refused(arguments, says):
    refused(says, tuning.explore, **arguments)


def test_the_browser_is_led_to_the_page_by_a_file_that_others_cannot_read(tmp_path):
    page = _forward(tmp_path, "http://127.0.0.1:1/token&x/")
    assert stat.S_IMODE(page.stat().st_mode) == 0o600
    assert "url=http://127.0.0.1:1/token&amp;x/" in page.read_text()


@pytest.mark.slow
def test_the_command_prints_the_address_and_opens_no_token_on_a_command_line(monkeypatch, capsys):
    opened, served = [], []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(Server, "run", lambda self: served.append(self.url))
    tuning.explore(LinearProblem(n=2, m=1), "kf", seeds=2).serve()
    (url,) = served
    assert url in capsys.readouterr().out and opened[0].startswith("file://") and url not in opened[0]
