"""The server of ``view``: only its own texts, only with the token, only from this machine."""

import http.client
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from pages import blocks, wedge
from processes import PATIENCE, hear_signals

import super_sdf
from super_sdf import SdfGrid, reconstruct, write_mesh
from super_sdf.errors import OptionError
from super_sdf.pages.server import PageServer

TEXTS = {"": "the page", "meshes/0.js": "the meshes"}


@pytest.fixture
def server():
    """A server of two texts, which runs until the test ends."""
    with PageServer(TEXTS) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield running
        running.shutdown()


def ask(server, path, method="GET", host=None):
    """Return status, headers and text of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)
    host = f"127.0.0.1:{server.server_port}" if host is None else host
    connection.request(method, path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, dict(answer.getheaders()), text


def test_the_page_and_its_meshes_are_there(server):
    base = f"/{server.token}/"
    assert server.address == f"http://127.0.0.1:{server.server_port}{base}"
    status, headers, text = ask(server, base)
    assert (status, text) == (200, "the page")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Cache-Control"] == "no-store" and headers["X-Frame-Options"] == "DENY"
    status, headers, text = ask(server, f"{base}meshes/0.js?again")
    assert (status, text) == (200, "the meshes")
    assert headers["Content-Type"] == "text/javascript; charset=utf-8"
    assert ask(server, base, "HEAD")[::2] == (200, "")
    assert ask(server, base, host=f"localhost:{server.server_port}")[0] == 200


PATHS = (
    "/", "", "/{wrong}/", "/{token}", "/{token}x/", "/{token}/meshes/1.js", "/favicon.ico",
    "/{token}/../etc/passwd", "/{token}/meshes/../../../etc/passwd", "/{token}/%2e%2e/etc/passwd",
    "//{token}//", "/{token}/tests/pages.py", "/\xe9/", "/{token}/meshes/", "/meshes/0.js",
)  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_everything_else_is_not_found(server, path):
    path = path.format(token=server.token, wrong="A" * len(server.token))
    assert server.find(f"127.0.0.1:{server.server_port}", path) is None
    if path.startswith("/") and path.isascii():
        assert ask(server, path)[::2] == (404, "not found\n")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", ""]
)
def test_a_page_of_another_name_gets_nothing(server, host):
    host = host.format(port=server.server_port)
    assert server.find(host, f"/{server.token}/") is None
    if host:
        assert ask(server, f"/{server.token}/", host=host)[0] == 404


def test_other_methods_are_refused(server):
    assert ask(server, f"/{server.token}/", "POST")[0] == 501


def test_it_is_bound_to_this_machine_and_tokens_differ(server):
    assert server.server_address[0] == "127.0.0.1"
    with PageServer(TEXTS) as other:
        assert other.token != server.token and len(other.token) >= 32


def test_a_port_that_is_taken_is_said():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OptionError, match=f"--port {port} cannot be used: .*; give another"):
            PageServer(TEXTS, port)


def test_the_command_serves_a_refined_grid_until_ctrl_c(tmp_path):
    np.save(tmp_path / "a.npy", wedge())
    arguments = ["view", "a.npy", "--no-browser", "--spacing", "1", "--quality", "fast"]
    sources = str(Path(super_sdf.__file__).parent.parent)
    with subprocess.Popen(
        [sys.executable, "-m", "super_sdf", *arguments, "--factor", "2", "--device", "cpu"],
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": sources},
        preexec_fn=hear_signals,
    ) as process:
        line = process.stderr.readline()
        port, path = re.fullmatch(
            r"http://127.0.0.1:(\d+)(/.*/) \(Ctrl-C ends it\)\n", line
        ).groups()
        connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=PATIENCE)
        connection.request("GET", path)
        page = connection.getresponse().read().decode()
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert blocks(page)["facts"]["title"] == "a.npy"
    assert (process.returncode, rest) == (130, "Error: interrupted; the page is closed\n")
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


def test_the_browser_is_opened_at_the_address_unless_it_is_not_wanted(
    command, tmp_path, monkeypatch
):
    def interrupted(server):
        raise KeyboardInterrupt

    opened = queue.Queue()
    monkeypatch.setattr(PageServer, "serve_forever", interrupted)
    monkeypatch.setattr("webbrowser.open", opened.put)
    mesh = tmp_path / "a.ply"
    write_mesh(reconstruct(SdfGrid(wedge(), 1.0), factor=2), mesh)
    code, out, err = command("view", mesh)
    assert (code, out) == (130, "") and err.endswith("\nError: interrupted; the page is closed\n")
    assert err.startswith(opened.get(timeout=PATIENCE) + " (Ctrl-C ends it)\n")
    assert command("view", mesh, "--no-browser")[0] == 130 and opened.empty()


def test_errors_of_view_are_one_line(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("view", "no.ply") == (1, "", "Error: no.ply does not exist\n")
    Path("bad.ply").write_text("ply")
    code, _, err = command("view", "bad.ply")
    assert code == 1 and err.startswith("Error: bad.ply cannot be read as a mesh: ")
    monkeypatch.setattr(
        "super_sdf.machine.extras.find_spec", lambda name: None if name == "pyfqmr" else 1
    )
    assert command("view", "a.npy") == (
        1, "", "Error: view needs pyfqmr: pip install -e '.[report]' in a clone of super-sdf\n"
    )  # fmt: skip
