"""Who may do what on a Zenoh router that others reach by TLS: mutual proof, and access by role."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

AUTHORITY, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
"""The files in the folder of a machine: whom it trusts, who it is, and what proves that."""

Role = Literal["host", "viewer"]
"""What the bearer of a certificate may do: all, or look on."""

STATES = "zenfi/stack/*/*/supervisor/**"
"""What viewers may see: the state of stacks and the changes of their processes."""

_ALL = ("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable")
_LIVELINESS = ("liveliness_token", "liveliness_query", "declare_liveliness_subscriber")


def common_name(role: Role) -> str:
    """The common name (CN) of all certificates of a role, which access control goes by."""
    return f"zenfi {role}"


def tls_settings(folder: Path) -> dict[str, object]:
    """Zenoh's settings for TLS where each end proves who it is, with the files of a machine's folder."""
    certificate, key = str(folder / CERTIFICATE), str(folder / KEY)
    settings = {
        "root_ca_certificate": str(folder / AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "close_link_on_expiration": True,
    }
    return {f"transport/link/tls/{name}": value for name, value in settings.items()}


def access_control() -> dict[str, object]:
    """Zenoh's access control: local sessions and hosts may do all, viewers see states, nobody else anything.

    Roles are told by the common name of a certificate. What comes over TLS is never local.
    """
    everything = _rule("everything", ("ingress", "egress"), (*_ALL, *_LIVELINESS), ("**",))
    asks = _rule("asks", ("ingress",), ("query", "declare_subscriber"), (STATES,))
    is_told = _rule(
        "is told", ("egress",), ("reply", "put", "declare_queryable", "declare_subscriber"), (STATES,)
    )
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [everything, asks, is_told],
            "subjects": [
                {"id": "local", "link_protocols": ["unixsock-stream", "tcp"]},
                {"id": "host", "link_protocols": ["tls"], "cert_common_names": [common_name("host")]},
                {"id": "viewer", "link_protocols": ["tls"], "cert_common_names": [common_name("viewer")]},
            ],
            "policies": [
                {"rules": ["everything"], "subjects": ["local", "host"]},
                {"rules": ["asks", "is told"], "subjects": ["viewer"]},
            ],
        }
    }


def _rule(
    name: str, flows: Sequence[str], messages: Sequence[str], keys: Sequence[str]
) -> Mapping[str, object]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(keys),
    }
