"""A release: archive, wheel, and a bill of materials of all that the wheel needs."""

import hashlib
import json
import shutil
from pathlib import Path
from zipfile import ZipFile

import pytest

from release.bill_of_materials import bill_of_materials
from release.build import build
from release.dependencies import ROOT, Dependencies
from tests.deploy.installed import PACKAGES


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    file = tmp_path / "zenfi-0.1.0-py3-none-any.whl"
    file.write_bytes(b"a wheel")
    return file


def test_the_bill_names_each_package_of_an_installation(wheel: Path) -> None:
    bill = json.loads(bill_of_materials(Dependencies.ours(), wheel))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    own = bill["metadata"]["component"]
    assert own["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"a wheel").hexdigest()}]
    found = {one["name"]: one for one in bill["components"]}
    version = found["numpy"]["version"]
    assert found["numpy"]["purl"] == f"pkg:pypi/numpy@{version}"
    assert found["starlette"]["licenses"] == [{"license": {"id": "BSD-3-Clause"}}]
    assert (found["llvmlite"]["scope"], found["distributed"]["scope"]) == ("required", "optional")
    assert "pytest" not in found
    needs = {one["ref"]: one.get("dependsOn", []) for one in bill["dependencies"]}
    assert found["numba"]["bom-ref"] in needs[own["bom-ref"]]
    assert found["llvmlite"]["bom-ref"] in needs[found["numba"]["bom-ref"]]


def test_a_wheel_has_one_bill(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    first, second = (bill_of_materials(Dependencies.ours(), wheel) for _ in range(2))
    assert first == second
    wheel.write_bytes(b"another wheel")
    assert bill_of_materials(Dependencies.ours(), wheel) != first


@pytest.mark.soak
def test_a_release_is_built_of_its_own_archive(tmp_path: Path) -> None:
    copy = tmp_path / "checkout"
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    files = build(copy, tmp_path / "release")
    assert [file.name.removeprefix("zenfi-") for file in files] == [
        "0.1.0-py3-none-any.whl",
        "0.1.0.cdx.json",
        "0.1.0.tar.gz",
    ]
    packed = {name for name in ZipFile(files[0]).namelist() if ".dist-info/" not in name}
    product = (file for name in PACKAGES for file in (ROOT / name).rglob("*") if file.is_file())
    assert packed == {str(file.relative_to(ROOT)) for file in product if "__pycache__" not in file.parts}
