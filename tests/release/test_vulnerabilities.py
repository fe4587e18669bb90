"""Known vulnerabilities: what could not be asked for is not taken for harmless."""

import json
from pathlib import Path
from typing import Any

import pytest

from release import vulnerabilities
from release.vulnerabilities import EXIT_NOT_ASKED, EXIT_VULNERABLE, KNOWN, NotAskedError, asked, check

CVE = {"id": "CVE-2018-18074", "fix_versions": ["2.20.0"]}


def entry(pinned: str, **more: Any) -> dict[str, Any]:
    name, _, version = pinned.partition("==")
    return {"name": name, "version": version, "vulns": [], **more}


def service(monkeypatch: pytest.MonkeyPatch, answers: dict[str, dict[str, Any]]) -> None:
    """Let pip-audit find these answers."""
    monkeypatch.setattr(vulnerabilities, "asked", lambda pinned: [answers[one] for one in pinned])


def test_a_vulnerability_is_told_with_the_version_that_mends_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = {"id": "CVE-1", "fix_versions": ["1.1"]}
    answers = {KNOWN: entry(KNOWN, vulns=[CVE]), "a==1": entry("a==1", vulns=[found]), "b==2": entry("b==2")}
    service(monkeypatch, answers)
    lock = tmp_path / "lock"
    lock.write_text("# versions\na==1\nb==2\n")
    monkeypatch.setattr(vulnerabilities, "LOCK", lock)
    assert vulnerabilities.main() == EXIT_VULNERABLE
    assert capsys.readouterr().out.splitlines() == [
        "a 1: CVE-1; mended in: 1.1",
        "2 packages asked for, 1 known vulnerabilities",
    ]


def test_a_service_that_knows_no_vulnerabilities_has_not_been_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    service(monkeypatch, {KNOWN: {"name": "requests", "skip_reason": "not found"}, "a==1": entry("a==1")})
    with pytest.raises(NotAskedError, match="does not tell the known vulnerability"):
        check(["a==1"])


def test_a_package_that_the_service_does_not_know_has_not_been_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = {"name": "a", "skip_reason": "not found"}
    service(monkeypatch, {KNOWN: entry(KNOWN, vulns=[CVE]), "a==1": unknown})
    with pytest.raises(NotAskedError, match="not known to the service: a"):
        check(["a==1"])


def test_without_a_network_it_says_that_nothing_was_checked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    assert vulnerabilities.main() == EXIT_NOT_ASKED
    told = capsys.readouterr()
    assert told.err.startswith("vulnerabilities: not checked: ")
    assert told.out == ""


def test_what_pip_audit_prints_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stand_in = tmp_path / "pip_audit.py"
    stand_in.write_text(f"print({json.dumps(json.dumps({'dependencies': [entry('a==1')]}))})")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert asked(["a==1"]) == [entry("a==1")]
    stand_in.write_text("raise SystemExit('no route to host')")
    with pytest.raises(NotAskedError, match="no route to host"):
        asked(["a==1"])
