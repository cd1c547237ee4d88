"""Software bill of materials (CycloneDX 1.6) from the locks: versions, hashes, package URLs, licences, dependencies."""

from __future__ import annotations

import importlib.metadata
import json
import re
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

from deploy import soup
from deploy.technical_file.places import ROOT, Row

HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")
EXTRAS = ("centre", "cohort", "files", "lsl", "telemetry")
"""Extras of pyproject.toml whose packages are in centre.txt."""
LICENCES = ROOT / "deploy" / "licences.toml"
BY_CLASSIFIER = {
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "ISC License (ISCL)": "ISC",
    "Python Software Foundation License": "PSF-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}
Package = tuple[str, str, tuple[str, ...], bool]
"""Name, version, hashes of its files, and whether it comes with an extra only."""


def packages() -> list[Package]:
    """Each pin of the locks, once: those of run.txt, then those that only an extra brings."""
    found: dict[tuple[str, str], Package] = {}
    for lock, optional in ((soup.LOCK, False), (soup.EXTRAS, True)):
        text = lock.read_text("utf-8")
        for name, version, _ in soup.pins(text, lock.name):
            block = re.search(rf"^{re.escape(name)}=={re.escape(version)}[ \\].*?(?=^\S|\Z)", text, re.M | re.S)
            hashes = tuple(HASH.findall(block[0])) if block else ()
            found.setdefault((name, version), (name, version, hashes, optional))
    return list(found.values())


@cache
def licences() -> Row:
    """What is allowed, and what metadata do not say."""
    return tomllib.loads(LICENCES.read_text("utf-8"))


@cache
def _spdx() -> Any:
    from license_expression import get_spdx_licensing  # of the test environment

    return get_spdx_licensing()


@cache
def said_by_metadata(name: str) -> str | None:
    """The SPDX expression of an installed package's own metadata, None where it says none."""
    try:
        metadata = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        return None
    classifiers = [one.rpartition(" :: ")[2] for one in metadata.get_all("Classifier", []) if one.startswith("License")]
    field = (metadata.get("License") or "").strip()
    said = metadata.get("License-Expression") or (field if len(field) < 60 else "")
    if said and not _spdx().validate(said).errors:
        return said
    return BY_CLASSIFIER.get(classifiers[0]) if len(classifiers) == 1 else None


def licence_of(name: str, stated: Row) -> str | None:
    """A package's licence as an SPDX expression: as metadata say, else as a person read it."""
    return said_by_metadata(name) or stated.get(name, {}).get("licence")


def licence_faults(names: Iterable[str], table: Row) -> Iterator[str]:
    """Packages whose licence is not known or not allowed, and entries that are not needed."""
    names = set(names)
    for name in sorted(names):
        licence = licence_of(name, table["stated"])
        if licence is None:
            yield f"{name}: no licence known; read it and state it in deploy/licences.toml"
        elif not _is_allowed(_spdx().parse(licence), table["allowed"]):
            yield f"{name}: {licence} is not allowed (deploy/licences.toml)"
    for name in sorted(table["stated"]):
        if name not in names or said_by_metadata(name):
            yield f"{name}: stated in deploy/licences.toml, and not needed"


def _is_allowed(parsed: Any, allowed: Row) -> bool:
    """Of alternatives one, of several together all."""
    if parsed.args:
        among = any if parsed.operator.strip() == "OR" else all
        return among(_is_allowed(one, allowed) for one in parsed.args)
    return parsed.render() in allowed


def build(version: str) -> str:
    """The bill as JSON, the same for the same locks: without a time and a serial number."""
    from cyclonedx.model.bom import Bom
    from cyclonedx.model.component import Component, ComponentType
    from cyclonedx.output.json import JsonV1Dot6

    root = Component(name="stimrig", version=version, type=ComponentType.APPLICATION, bom_ref="stimrig")
    root.licenses.add(_licence("MIT"))
    parts: dict[str, list[Any]] = {}
    for package in packages():
        parts.setdefault(package[0], []).append(_component(*package))
    bom: Any = Bom(components=[one for several in parts.values() for one in several])
    bom.metadata.component = root
    bom.register_dependency(root, _all(parts, _own_needs()))
    for name, several in parts.items():
        for part in several:
            bom.register_dependency(part, _all(parts, _needs(name)))
    return _without_date(JsonV1Dot6(bom).output_as_string())


def _component(name: str, version: str, hashes: tuple[str, ...], optional: bool) -> Any:
    """A package as CycloneDX has it; the hashes are of its files for all platforms, of which one is installed."""
    from cyclonedx.model import ExternalReference, ExternalReferenceType, HashAlgorithm, HashType, XsUri
    from cyclonedx.model.component import Component, ComponentScope, ComponentType
    from packageurl import PackageURL

    purl = PackageURL("pypi", None, name, version)
    files = ExternalReference(
        type=ExternalReferenceType.DISTRIBUTION,
        url=XsUri(str(purl)),
        comment="one of these files is installed, by platform",
        hashes=[HashType(alg=HashAlgorithm.SHA_256, content=one) for one in hashes],
    )
    licence = licence_of(name, licences()["stated"])
    return Component(
        name=name,
        version=version,
        purl=purl,
        bom_ref=str(purl),
        type=ComponentType.LIBRARY,
        scope=ComponentScope.OPTIONAL if optional else ComponentScope.REQUIRED,
        licenses=[_licence(licence)] if licence else [],
        external_references=[files],
    )


@cache
def _licence(expression: str) -> Any:
    from cyclonedx.contrib.license.factories import LicenseFactory

    return LicenseFactory().make_from_string(expression)


def _all(parts: dict[str, list[Any]], names: set[str]) -> list[Any]:
    return [part for name in sorted(names & parts.keys()) for part in parts[name]]


def _needs(name: str) -> set[str]:
    """Names of what an installed package says it needs, whatever its markers."""
    try:
        wanted = importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:
        return set()
    return {_plain(one) for one in wanted if "extra ==" not in one}


def _own_needs() -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = (one for name in EXTRAS for one in project["optional-dependencies"][name])
    return {_plain(one) for one in (*project["dependencies"], *extras)}


def _plain(requirement: str) -> str:
    """The name in a requirement, as the locks write it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()


def _without_date(text: str) -> str:
    document = json.loads(text)
    document.pop("serialNumber", None)
    document.get("metadata", {}).pop("timestamp", None)
    return json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def schema_faults(text: str) -> list[str]:
    """What CycloneDX's own schema says against a bill, a line each."""
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    errors = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text, all_errors=True)
    return [str(error) for error in errors or ()]
