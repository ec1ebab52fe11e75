"""The control socket: what it understands, whom it lets in, and that a stop waits for nobody."""

from __future__ import annotations

import itertools
import json
import os
import select
import socket
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.cycle.machine import State
from controller.errors import SorterError
from controller.service import control
from controller.service.client import CommandFailed, ControlClient
from controller.service.control import BURST, MAX_CLIENTS, MAX_LINE, ControlServer
from controller.service.requests import CHANGING, READING, BadRequest, parse
from controller.service.unix_socket import Peer, address_of, connect, peer_of
from tests.unit.service.cell_double import PretendedCell


@pytest.fixture
def cell() -> PretendedCell:
    return PretendedCell()


@pytest.fixture
def server(tmp_path: Path, cell: PretendedCell) -> Iterator[ControlServer]:
    with ControlServer(tmp_path, cell) as serving:
        yield serving


@pytest.fixture
def client(server: ControlServer) -> ControlClient:
    return ControlClient(server.path.parent)


class Line:
    """One raw connection."""

    def __init__(self, line: socket.socket) -> None:
        self.line = line
        self._file = line.makefile("rb")

    def send(self, *requests: object) -> None:
        self.line.sendall(b"".join(json.dumps(request).encode() + b"\n" for request in requests))

    def reply(self) -> Any:
        data = self._file.readline()
        return json.loads(data) if data else None

    def close(self) -> None:
        self._file.close()


@contextmanager
def _connected(path: Path) -> Iterator[Line]:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(20.0)
        with address_of(path) as address:
            raw.connect(address)
        line = Line(raw)
        try:
            yield line
        finally:
            line.close()


# --- commands -----------------------------------------------------------------------------------------------


def test_the_commands_do_what_they_say(client: ControlClient, cell: PretendedCell) -> None:
    assert client.ask("status")["state"] == "STOPPED"
    assert client.ask("start")["state"] == "EXECUTE"
    assert client.ask("pause")["state"] == "HELD"
    assert client.ask("resume")["state"] == "EXECUTE"
    assert client.ask("stop") is None
    assert client.ask("reset")["state"] == "STOPPED"
    assert cell.told == ["start", "pause", "resume", "stop", "reset"]


def test_a_command_the_state_does_not_allow_is_refused_with_cause_and_remedy(
    client: ControlClient, cell: PretendedCell
) -> None:
    cell.state = State.FAULT
    with pytest.raises(CommandFailed, match="not possible in FAULT: stop first") as caught:
        client.ask("start")
    assert caught.value.code == "refused"
    assert cell.told == []


@pytest.mark.safety("SR-22")
def test_acknowledging_an_alarm_neither_clears_nor_resets_it(client: ControlClient, cell: PretendedCell) -> None:
    cell.state = State.FAULT
    cell.log.raise_("camera_lost", "/dev/video0 is gone", "plug it in")
    assert client.ask("acknowledge", alarm=1) == 1
    (alarm,) = client.ask("alarms")
    assert alarm["acknowledged_at"] is not None
    assert alarm["active"] is True
    assert client.ask("status")["state"] == "ABORTED"
    client.ask("reset")
    assert client.ask("alarms")[0]["active"] is False


def test_a_mistake_in_a_command_is_answered_and_survived(client: ControlClient) -> None:
    with pytest.raises(CommandFailed, match="internal error") as caught:
        client.ask("reload")
    assert caught.value.code == "failed"
    assert client.ask("status")["state"] == "STOPPED"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"\xff\xfe", "bad_request"),
        (b"no json", "bad_request"),
        (b"[1]", "bad_request"),
        (b"[" * 4000, "bad_request"),
        (b'{"id": [1], "command": "status"}', "bad_request"),
        (b'{"id": true, "command": "status", "x": 1}', "bad_request"),
        (b'{"command": "acknowledge", "alarm": "all"}', "bad_request"),
        (b'{"command": "acknowledge", "alarm": true}', "bad_request"),
        (b'{"command": "start", "speed": 100}', "bad_request"),
        (b'{"command": "start", "view_clear": "yes"}', "bad_request"),
        (b'{"command": "stop", "when": "later"}', "unknown_command"),
        (b'{"command": "__init__"}', "unknown_command"),
        (b'{"command": ["start"]}', "unknown_command"),
        (b"{}", "unknown_command"),
    ],
)
def test_what_makes_no_sense_is_answered_and_moves_nothing(
    server: ControlServer, cell: PretendedCell, line: bytes, code: str
) -> None:
    with _connected(server.path) as raw:
        raw.line.sendall(line + b'\n\n{"command": "status", "id": "after"}\n')
        assert raw.reply()["error"]["code"] == code
        assert raw.reply()["id"] == "after"
    assert cell.told == []


@given(st.binary(max_size=200))
def test_parsing_any_bytes_gives_a_request_or_a_bad_request(data: bytes) -> None:
    try:
        assert isinstance(parse(data).id, str | int | None)
    except BadRequest as error:
        assert error.error["cause"]


@settings(max_examples=30, deadline=None)
@given(data=st.binary(max_size=400))
@pytest.mark.safety("SR-42")
def test_no_bytes_crash_the_server_or_move_the_cell(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    cell = PretendedCell()
    with ControlServer(tmp_path_factory.mktemp("c"), cell) as server:
        with _connected(server.path) as raw:
            raw.line.sendall(data)
        assert ControlClient(server.path.parent).ask("status")["state"] == "STOPPED"
    assert cell.told == []


def test_the_documented_commands_are_those_there_are() -> None:
    documented = {
        name.strip("` ")
        for row in (control.__doc__ or "").splitlines()
        if row.startswith("| `")
        for name in row.split("|")[1].split("(")[0].split(",")
    }
    assert documented == {*READING, *CHANGING, "stop"}


# --- a stop waits for nobody --------------------------------------------------------------------------------


@pytest.mark.safety("SR-20")
def test_a_stop_overtakes_a_slow_command_on_its_own_connection(server: ControlServer, cell: PretendedCell) -> None:
    cell.gate.clear()
    with _connected(server.path) as raw:
        raw.send({"command": "pause", "id": 1}, {"command": "status", "id": 2}, {"command": "stop", "id": 3})
        replies = [raw.reply(), raw.reply()]
        assert {reply["id"] for reply in replies} == {2, 3}
        assert cell.told == ["stop"]
        cell.gate.set()
        assert raw.reply()["id"] == 1


def test_a_stop_waits_for_no_log(client: ControlClient, cell: PretendedCell, monkeypatch: pytest.MonkeyPatch) -> None:
    told_when_logged: list[list[str]] = []
    monkeypatch.setattr(control._log, "warning", lambda *what: told_when_logged.append(list(cell.told)))
    client.ask("stop")
    assert told_when_logged == [["stop"]]


@pytest.mark.safety("SR-20")
def test_a_start_that_a_stop_overtakes_leaves_the_cell_stopped(server: ControlServer, cell: PretendedCell) -> None:
    cell.gate.clear()
    with _connected(server.path) as slow, _connected(server.path) as quick:
        slow.send({"command": "start"})
        assert cell.entered.wait(20.0)
        quick.send({"command": "stop"})
        assert quick.reply()["ok"] is True
        cell.gate.set()
        assert slow.reply()["error"]["code"] == "refused"
    # The start went through after the stop: what it began is stopped again.
    assert cell.told == ["stop", "start", "stop"]
    assert cell.state is State.STOPPED


def test_a_second_change_is_refused_rather_than_kept_for_later(server: ControlServer, cell: PretendedCell) -> None:
    cell.gate.clear()
    with _connected(server.path) as first, _connected(server.path) as second:
        first.send({"command": "pause"})
        assert cell.entered.wait(20.0)
        second.send({"command": "resume"})
        assert second.reply()["error"]["code"] == "busy"
        second.send({"command": "status"})
        assert second.reply()["ok"] is True
        cell.gate.set()
        assert first.reply()["ok"] is True
    assert cell.told == ["pause"]


@pytest.mark.safety("SR-20")
def test_a_flood_of_connections_does_not_keep_a_stop_out(server: ControlServer, cell: PretendedCell) -> None:
    lines = [socket.socket(socket.AF_UNIX) for _ in range(MAX_CLIENTS + 20)]
    try:
        for line in lines:
            connect(line, str(server.path), 20.0)
            line.settimeout(20.0)
        assert ControlClient(server.path.parent).ask("stop") is None
        # The one that was silent for longest had to go.
        assert lines[0].recv(1) == b""
    finally:
        for line in lines:
            line.close()
    assert cell.told == ["stop"]


@pytest.mark.safety("SR-20")
def test_a_flood_of_requests_is_held_back_but_not_the_stop_in_it(tmp_path: Path, cell: PretendedCell) -> None:
    with ControlServer(tmp_path, cell, now=lambda: 0.0) as server, _connected(server.path) as raw:
        raw.send(*[{"command": "status"}] * 400, {"command": "stop", "id": "stop"})
        replies = [raw.reply() for _ in range(401)]
    codes = Counter(reply["error"]["code"] for reply in replies if not reply["ok"])
    # While no time passes a user has 100 requests; of those some may find the room for waiting ones full.
    assert codes["too_fast"] == 400 - BURST
    assert set(codes) <= {"too_fast", "busy"}
    assert cell.told == ["stop"]


# --- limits and deadlines -----------------------------------------------------------------------------------


def test_a_request_that_is_too_long_ends_the_connection(server: ControlServer) -> None:
    with _connected(server.path) as raw:
        raw.line.sendall(b"x" * (MAX_LINE + 1))
        assert raw.reply()["error"]["code"] == "too_large"
        assert raw.reply() is None


@pytest.mark.safety("SR-27")
def test_a_request_that_is_never_finished_is_given_up(tmp_path: Path) -> None:
    times = itertools.count(0.0, 3.0)
    with ControlServer(tmp_path, PretendedCell(), now=lambda: next(times)) as server, _connected(server.path) as raw:
        raw.line.sendall(b'{"command": ')
        assert raw.reply() is None


def test_a_command_that_never_ends_is_answered_in_time(
    tmp_path: Path, cell: PretendedCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "REPLY_TIMEOUT", 0.01)
    cell.gate.clear()
    with ControlServer(tmp_path, cell) as server, _connected(server.path) as raw:
        raw.send({"command": "reset", "id": 7})
        reply = raw.reply()
        assert (reply["id"], reply["error"]["code"]) == (7, "timeout")
        cell.gate.set()


def test_one_who_has_said_all_still_gets_his_reply(server: ControlServer) -> None:
    with _connected(server.path) as raw:
        raw.send({"command": "status"})
        raw.line.shutdown(socket.SHUT_WR)
        assert raw.reply()["result"]["state"] == "STOPPED"
        assert raw.reply() is None


def test_one_who_never_reads_is_dropped_and_nobody_else_suffers(server: ControlServer, cell: PretendedCell) -> None:
    for number in range(150):
        cell.log.raise_(f"fault_{number}", "c" * 200, "r" * 200)
    with _connected(server.path) as deaf:
        deaf.send(*[{"command": "alarms"}] * 60)
        assert ControlClient(server.path.parent).ask("stop") is None
        # 60 replies of some 90 kB are far more than the 256 kB that are kept for him.
        hung_up = select.poll()
        hung_up.register(deaf.line, select.POLLRDHUP)
        assert hung_up.poll(20_000)


def test_the_server_shows_that_it_is_alive(tmp_path: Path) -> None:
    beats: list[int] = []
    with ControlServer(tmp_path, PretendedCell(), progress=lambda: beats.append(1)) as server:
        ControlClient(server.path.parent).ask("status")
    assert beats


# --- who may talk -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("peer", "group", "allowed"),
    [
        (Peer(1, os.geteuid(), 5), None, True),
        (Peer(1, 0, 0), None, True),
        (Peer(1, 4321, 5), None, False),
        (Peer(1, 4321, 5), 5, True),
        (Peer(1, 4321, 6, (7, 5)), 5, True),
        (Peer(1, 4321, 6, (7, 8)), 5, False),
    ],
)
@pytest.mark.safety("SR-42")
def test_the_same_user_root_and_the_group_may_talk(peer: Peer, group: int | None, allowed: bool) -> None:
    assert peer.may_control(group) is allowed


@pytest.mark.safety("SR-42")
def test_a_stranger_is_told_so_and_sent_away(
    server: ControlServer, cell: PretendedCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "peer_of", lambda line: Peer(1, 4321, 4321))
    with _connected(server.path) as raw:
        assert raw.reply()["error"]["code"] == "forbidden"
        assert raw.reply() is None
    with pytest.raises(SorterError):
        ControlClient(server.path.parent).ask("stop")
    assert cell.told == []


def test_the_kernel_says_who_is_there(server: ControlServer) -> None:
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(server.path))
        peer = peer_of(line)
    assert (peer.pid, peer.uid, peer.gid) == (os.getpid(), os.geteuid(), os.getegid())
    assert set(peer.groups) == set(os.getgroups())


def test_the_process_s_group_operates_only_where_a_service_manager_chose_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert control.operators() is None
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/sorter")
    assert control.operators() == os.getegid()


@pytest.mark.parametrize(("group", "mode"), [(None, 0o600), (os.getegid(), 0o660)])
def test_the_socket_itself_is_open_to_no_others(tmp_path: Path, group: int | None, mode: int) -> None:
    with ControlServer(tmp_path, PretendedCell(), group=group) as server:
        assert stat.S_IMODE(server.path.stat().st_mode) == mode
