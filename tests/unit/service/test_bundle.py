"""The support bundle: what is in it, and what must never be."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import stat
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.cli import execute
from controller.config.files import shipped
from controller.errors import SorterError
from controller.ledger import SqliteLedger
from controller.service import bundle as bundle_module
from controller.service.bundle import collect, write
from controller.service.doctor.case import Case
from controller.service.secrets import REMOVED, json_without_secrets, without_secrets
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

# Everything here is made up; none of it may be in a bundle.
PLANTED = {
    "hunter2hunter2": "mqtt_password = hunter2hunter2",
    "tr0ub4dor&3": 'password: "tr0ub4dor&3"',
    "c0ffee00c0ffee": '{"api_key": "c0ffee00c0ffee", "x": 1}',
    "s3same0pen": "controller run --token s3same0pen --config cell.toml",
    "q1w2e3r4t5": "Authorization: Bearer q1w2e3r4t5",
    "bob:wordpass": "fetching https://bob:wordpass@broker.example.org/x",
    "MIIEabcdefghijk": "-----BEGIN PRIVATE KEY-----\nMIIEabcdefghijk\n-----END PRIVATE KEY-----",
    "ghp_0123456789abcdefghij": "clone with ghp_0123456789abcdefghij",
    "eyJhbGciOi.eyJzdWIiOi": "session eyJhbGciOi.eyJzdWIiOi.abcdef0",
    "erika.muster": "mail erika.muster@example.org when it stops",
    "erikamuster": "/home/erikamuster/cell.toml",
    "0penSesame": "Environment=WEB_SECRET=0penSesame",
    "WpaPassPhrase1": "psk_passphrase='WpaPassPhrase1'",
}
ALL = "\n".join(f"# {line}" for line in PLANTED.values())


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Case:
    """A cell with secrets in every file that goes into a bundle, and in its journal."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    monkeypatch.setenv("HOME", str(tmp_path))  # a home anywhere has its owner's name in its path
    state, root = tmp_path / "state", tmp_path / "root"
    (state / "calibration").mkdir(parents=True)
    (root / "etc/systemd/system").mkdir(parents=True)
    config = tmp_path / "cell.toml"
    config.write_text(f"{ALL}\n{shipped('cell.toml').read_text(encoding='utf-8')}", encoding="utf-8")
    (state / "bins.toml").write_text(ALL, encoding="utf-8")
    (state / "calibration" / "camera.json").write_text(json.dumps({"note": ALL, "rms_px": 0.25}), encoding="utf-8")
    (root / "etc/systemd/system/controller.service").write_text(f"[Service]\n{ALL}\n", encoding="utf-8")
    (root / "etc/os-release").write_text(f"NAME=Test\n{ALL}\n", encoding="utf-8")
    with SqliteLedger(state / "ledger.db", clock=VirtualClock()) as ledger:
        ledger.begin_run(software_version="1", config_hash="abc", note=ALL)
        ledger.intend("t1", plan("t1"), 1, 0.0)
        ledger.conclude(outcome("t1"))
        ledger.note("odd", 1.0, text=ALL, password="hunter2hunter2", pin={"token": "c0ffee00c0ffee"})
    return Case(state, config, root=root, run=_journal, clock_in_step=lambda: True)


def _journal(command: Sequence[str]) -> str:
    if command[0] != "journalctl":
        raise SorterError(f"{command[0]}: no such command", f"never mind {ALL}")
    assert "--no-hostname" in command
    return f"2026-03-10T12:00:00 controller[1]: INFO placed\n{ALL}\non {platform.node()}\n"


def test_no_planted_secret_gets_into_the_archive(case: Case, tmp_path: Path) -> None:
    path = tmp_path / "bundle.zip"
    contents = write(collect(case), path, "2026-03-10")
    with zipfile.ZipFile(path) as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist()}
    for name, text in texts.items():
        for secret in PLANTED:
            assert secret not in text, f"{secret} is in {name}"
        assert str(tmp_path) not in text, name
        if len(platform.node()) > 2:
            assert platform.node() not in text
    # What the reader needs is still there.
    assert {"bundle.json", "doctor.json", "versions.json", "system.txt", "journal.txt", "ledger/outcomes.jsonl"} <= set(
        texts
    )
    assert "INFO placed" in texts["journal.txt"]
    assert 'description = "reactorx_150"' in texts["configuration/cell.toml"]
    assert json.loads(texts["calibration/camera.json"])["rms_px"] == 0.25
    assert [json.loads(line)["result"] for line in texts["ledger/outcomes.jsonl"].splitlines()] == ["placed"]
    assert json.loads(texts["ledger/verify.json"])["problems"] == []
    assert json.loads(texts["bundle.json"]) == contents
    assert "cell" in json.loads(texts["bundle.json"])["missing"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@given(st.text(st.characters(codec="ascii", categories=("L", "N")), min_size=8, max_size=40))
def test_whatever_the_password_is(secret: str) -> None:
    for line in (f"password = {secret}", f'"auth_token": "{secret}"', f"X-Api-Key: {secret}", f"--secret {secret} -v"):
        found, removed = without_secrets(line)
        assert removed >= 1
        # A text of so many letters may be a part of what is said instead; it is not there as a word.
        assert secret not in found.replace(REMOVED, "") or secret in line.replace(secret, "", 1)


def test_json_within_a_text_within_json_is_cleaned_too() -> None:
    inner = json.dumps({"password": "hunter2hunter2", "n": 1})
    for text in (inner, json.dumps({"note": inner}), json.dumps({"note": json.dumps({"note": inner})})):
        assert "hunter2" not in without_secrets(text)[0]
        cleaned, removed = json_without_secrets(json.loads(text))
        assert (removed, "hunter2" in json.dumps(cleaned)) == (1, False)


@given(st.text(max_size=300))
def test_any_text_can_be_cleaned(text: str) -> None:
    without_secrets(text, "name")


@pytest.mark.parametrize(
    "line",
    [
        "calibration cell-e75e4047a024, configuration 35539e404d16a57b",
        "exposure = 156.0  # 100 us each",
        "2026-11-22 12:00:00 camera_lost: /dev/video0: read: unplugged: plug it in",
        '{"target_id": "t12", "x_mm": -40.6, "reason": "in squares"}',
        "servo 3 (elbow): read Present_Position: timeout",
    ],
)
def test_what_a_helper_needs_stays(line: str) -> None:
    assert without_secrets(line) == (line, 0)


def test_a_machine_on_which_nothing_works_still_gives_a_bundle(
    tmp_path: Path, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(bundle_module, "_ledger", broken)
    case = dataclasses.replace(case, state=tmp_path / "none", config=None, run=_no_command)
    found = collect(case)
    assert set(found.missing) == {"configuration", "ledger", "journal.txt", "cell"}
    assert found.missing["ledger"] == "RuntimeError: out of memory"
    assert "doctor.json" in found.texts


def _no_command(command: Sequence[str]) -> str:
    raise SorterError(f"{command[0]}: no such command")


def test_a_journal_that_is_kept_from_whoever_asks_is_named_as_missing(case: Case) -> None:
    with pytest.raises(SorterError, match="the journal shows nothing of the service: ask as root"):
        list(bundle_module._journal(dataclasses.replace(case, run=lambda command: "\n")))


def test_of_a_long_text_the_end_is_kept(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle_module, "MOST_BYTES", 1000)
    found = collect(dataclasses.replace(case, run=lambda command: "x" * 5000 + "the end"))
    assert len(found.texts["journal.txt"]) < 1200
    assert found.texts["journal.txt"].endswith("the end")


def test_the_command(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert execute(["bundle", str(case.state), "--out", "b.zip", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["path"] == "b.zip"
    assert "configuration" in found["missing"]
    assert execute(["bundle", str(case.state), "--out", "b.zip"]) == 1  # nothing is overwritten
    assert execute(["bundle", str(tmp_path / "none")]) == 1
    assert execute(["bundle", str(case.state)]) == 0
    assert len(list(tmp_path.glob("bundle-*.zip"))) == 1
    assert os.listdir(tmp_path / "root") == ["etc"]
