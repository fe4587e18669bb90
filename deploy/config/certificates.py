"""Certificates for machines that meet on Zenoh over TLS: one authority, a folder for each machine."""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from deploy.config.link_security import AUTHORITY, CERTIFICATE, KEY, Role, common_name
from deploy.errors import BadSpecError

AUTHORITY_KEY = "ca-key.pem"
"""What makes further certificates; it stays where they are made."""

_AUTHORITY_DAYS = 3650
_EARLIER = timedelta(hours=1)
"""How far the clock of another machine may be behind ours."""
_NAME = r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,61}[A-Za-z0-9])?$"


@dataclass(frozen=True, slots=True)
class Machine:
    """For whom a certificate is: its name, the other names or addresses by which it is reached, its role."""

    name: str
    addresses: tuple[str, ...] = ()
    role: Role = "host"

    @classmethod
    def parse(cls, text: str, role: Role) -> Machine:
        """Parse ``NAME`` or ``NAME=ADDRESS,...``.

        :raises BadSpecError: if that is no name of a machine.
        """
        name, _, more = text.partition("=")
        addresses = tuple(filter(None, more.split(",")))
        for one in (name, *addresses):
            if not re.fullmatch(_NAME, one) and not _is_address(one):
                message = f"{text}: {one!r} is neither a host name nor an address"
                raise BadSpecError(message)
        return cls(name, addresses, role)


def write_certificates(folder: Path, machines: Sequence[Machine], days: int) -> list[Path]:
    """Make a folder with authority, certificate and key for each machine; the paths of the folders.

    The authority is made if there is none in ``folder``. All files are readable by their owner alone.

    :raises BadSpecError: if one of the folders is there already, or the authority's key is missing.
    """
    folders = [folder / machine.name for machine in machines]
    for one in folders:
        if one.exists():
            message = f"{one} is there already: remove it first if it is to be made anew"
            raise BadSpecError(message)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (folder / AUTHORITY).exists() and not (folder / AUTHORITY_KEY).exists():
        _make_authority(folder)
    authority, key = _authority(folder)
    for machine, own in zip(machines, folders, strict=True):
        own.mkdir(mode=0o700)
        certificate, private = _certificate(machine, authority, key, timedelta(days=days))
        _write(own / AUTHORITY, (folder / AUTHORITY).read_bytes())
        _write(own / KEY, private)
        _write(own / CERTIFICATE, certificate)
    return folders


def _make_authority(folder: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _named("zenfi authority")
    made = (
        _lasting(x509.CertificateBuilder(), timedelta(days=_AUTHORITY_DAYS))
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_signs(), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    _write(folder / AUTHORITY_KEY, _pem(key))
    _write(folder / AUTHORITY, _signed(made, key))


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
        key = load_pem_private_key((folder / AUTHORITY_KEY).read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        message = (
            f"{folder}: {AUTHORITY} and {AUTHORITY_KEY} are not those of an authority made here: {error}"
        )
        raise BadSpecError(message) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        message = f"{folder}: {AUTHORITY_KEY} is not the key of {AUTHORITY}"
        raise BadSpecError(message)
    return certificate, key


def _certificate(
    machine: Machine, authority: x509.Certificate, authority_key: ec.EllipticCurvePrivateKey, valid: timedelta
) -> tuple[bytes, bytes]:
    key = ec.generate_private_key(ec.SECP256R1())
    names = [
        x509.IPAddress(ipaddress.ip_address(one)) if _is_address(one) else x509.DNSName(one)
        for one in (machine.name, *machine.addresses)
    ]
    # Both ends of a link prove who they are, so each certificate serves for either.
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if machine.role == "host":
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
    made = (
        _lasting(x509.CertificateBuilder(), valid)
        .subject_name(_named(common_name(machine.role)))
        .issuer_name(authority.subject)
        .public_key(key.public_key())
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), critical=False
        )
    )
    return _signed(made, authority_key), _pem(key)


def _lasting(builder: x509.CertificateBuilder, valid: timedelta) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        builder.serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + valid)
    )


def _named(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _signs() -> x509.KeyUsage:
    rights = dict.fromkeys(
        (
            "digital_signature",
            "content_commitment",
            "key_encipherment",
            "data_encipherment",
            "key_agreement",
            "encipher_only",
            "decipher_only",
        ),
        False,
    )
    return x509.KeyUsage(key_cert_sign=True, crl_sign=True, **rights)


def _signed(builder: x509.CertificateBuilder, key: ec.EllipticCurvePrivateKey) -> bytes:
    return builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _write(path: Path, content: bytes) -> None:
    """Write a file that is not there yet, readable by its owner alone."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
