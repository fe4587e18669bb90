"""Certificates as files: who may read them, for whom they are, and that none is overwritten."""

import ssl
from pathlib import Path

import pytest

from deploy.config.certificates import AUTHORITY_KEY, Machine, write_certificates
from deploy.config.link_security import AUTHORITY, CERTIFICATE, KEY
from deploy.errors import BadSpecError

LAB = Machine("lab-1", ("10.0.0.1", "lab-1.example"))


def test_each_machine_gets_a_folder_that_its_owner_alone_can_read(tmp_path: Path) -> None:
    folder = tmp_path / "certificates"
    assert write_certificates(folder, [LAB, Machine("laptop", role="viewer")], 30) == [
        folder / "lab-1",
        folder / "laptop",
    ]
    modes = {str(one.relative_to(folder)): one.stat().st_mode & 0o777 for one in folder.rglob("*")}
    files = {f"{name}/{file}" for name in ("lab-1", "laptop") for file in (AUTHORITY, CERTIFICATE, KEY)}
    assert {name for name, mode in modes.items() if mode == 0o600} == files | {AUTHORITY, AUTHORITY_KEY}
    assert {name for name, mode in modes.items() if mode == 0o700} == {"lab-1", "laptop"}


def test_a_certificate_is_for_the_names_and_addresses_of_its_machine_and_fits_its_key(tmp_path: Path) -> None:
    (lab,) = write_certificates(tmp_path, [LAB], 30)
    ssl.create_default_context(cafile=lab / AUTHORITY).load_cert_chain(lab / CERTIFICATE, lab / KEY)
    from cryptography import x509

    certificate = x509.load_pem_x509_certificate((lab / CERTIFICATE).read_bytes())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["lab-1", "lab-1.example"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.1"]


def test_what_is_there_is_not_overwritten_and_the_authority_is_used_again(tmp_path: Path) -> None:
    (lab,) = write_certificates(tmp_path, [LAB], 30)
    before = {
        one: one.read_bytes() for one in (*lab.iterdir(), tmp_path / AUTHORITY, tmp_path / AUTHORITY_KEY)
    }
    with pytest.raises(BadSpecError, match="lab-1 is there already: remove it first"):
        write_certificates(tmp_path, [Machine("lab-2"), LAB], 30)
    assert not (tmp_path / "lab-2").exists()
    (second,) = write_certificates(tmp_path, [Machine("lab-2")], 30)
    assert (second / AUTHORITY).read_bytes() == (lab / AUTHORITY).read_bytes()
    assert before == {one: one.read_bytes() for one in before}


def test_an_authority_without_its_key_makes_nothing(tmp_path: Path) -> None:
    write_certificates(tmp_path, [LAB], 30)
    (tmp_path / AUTHORITY_KEY).unlink()
    with pytest.raises(BadSpecError, match=r"ca-key\.pem"):
        write_certificates(tmp_path, [Machine("lab-2")], 30)
    assert not (tmp_path / "lab-2").exists()


@pytest.mark.parametrize("text", ["", "../etc", "a/b", "lab=10.0.0.1,no good", "-x", "a" * 64])
def test_what_is_no_name_of_a_machine_is_refused(text: str) -> None:
    with pytest.raises(BadSpecError, match="neither a host name nor an address"):
        Machine.parse(text, "host")
