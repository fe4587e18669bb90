"""The software bill of materials of a release: what a wheel needs, in CycloneDX's JSON."""

from __future__ import annotations

import hashlib
import os
import uuid
from datetime import UTC, datetime
from importlib.metadata import distribution
from pathlib import Path

from cyclonedx.contrib.license.factories import LicenseFactory
from cyclonedx.model import HashAlgorithm, HashType
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentScope, ComponentType
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL

from release.dependencies import EVERY_INSTALLATION, OWN, TESTS, Dependencies, Package

LICENCE = "Apache-2.0"


def bill_of_materials(dependencies: Dependencies, wheel: Path) -> str:
    """What a wheel needs in the versions that the lock has; what only extras bring along is optional.

    The same wheel has the same bill, if SOURCE_DATE_EPOCH says when that is.

    :raises ValueError: if it does not keep to CycloneDX's schema.
    """
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    own = _component(Package(OWN, distribution(OWN).version, LICENCE, EVERY_INSTALLATION))
    own.hashes.add(HashType(alg=HashAlgorithm.SHA_256, content=digest))
    shipped = [one for one in dependencies.packages if one.used != TESTS]
    components = {one.name: _component(one) for one in shipped}
    bom = Bom(serial_number=uuid.uuid5(uuid.NAMESPACE_URL, digest), components=components.values())
    bom.metadata.component = own
    bom.metadata.timestamp = _now()
    always = (one.name for one in shipped if one.used.startswith(EVERY_INSTALLATION))
    bom.register_dependency(own, [components[name] for name in always if name in dependencies.direct])
    for name, component in components.items():
        bom.register_dependency(component, [components[need] for need in dependencies.needs(name)])
    told = JsonV1Dot6(bom).output_as_string(indent=2)
    if wrong := JsonStrictValidator(SchemaVersion.V1_6).validate_str(told):
        raise ValueError(repr(wrong))
    return told


def _component(package: Package) -> Component:
    address = PackageURL("pypi", name=package.name, version=package.version)
    required = package.used.startswith(EVERY_INSTALLATION)
    return Component(
        name=package.name,
        version=package.version,
        type=ComponentType.APPLICATION if package.name == OWN else ComponentType.LIBRARY,
        scope=ComponentScope.REQUIRED if required else ComponentScope.OPTIONAL,
        purl=address,
        bom_ref=str(address),
        licenses=[LicenseFactory().make_from_string(package.licence)],
    )


def _now() -> datetime:
    seconds = os.environ.get("SOURCE_DATE_EPOCH")
    return datetime.fromtimestamp(int(seconds), UTC) if seconds else datetime.now(UTC)
