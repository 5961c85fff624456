"""`tenuto keys init DIR`: an authority, a certificate for each role, and the key that signs policies."""

from __future__ import annotations

import ipaddress
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from rich.console import Console
from tyro.conf import Positional, UseAppendAction

from launcher.cli import DONE
from launcher.parsing import HELP_FLAGS, parse
from rtcore.channels import LEARNER
from rtcore.config import ConfigError
from rtcore.signing import AUTHORITY, CERTIFICATE, KEY, POLICY_KEY, POLICY_PUBLIC, ROLES

PrivateKey = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey

AUTHORITY_HOME, AUTHORITY_KEY = "ca", "ca.key"
LOCAL = ("localhost", "127.0.0.1")
SLACK = timedelta(hours=1)  # hosts whose clocks are behind accept it at once
_HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)(\.(?!-)[A-Za-z0-9-]{1,63}(?<!-))*")


@dataclass(frozen=True)
class InitOptions:
    """Make keys and certificates."""

    directory: Positional[Path]
    """Where they go; it must not exist yet."""
    host: Annotated[tuple[str, ...], UseAppendAction] = ()
    """A further name or address that a process of the run is reached by; may be given several times."""
    days: int = 365
    """How long the certificates are valid."""


def keys(argv: Sequence[str]) -> int:
    """`tenuto keys init DIR`."""
    if argv and argv[0] in HELP_FLAGS:
        argv = ["init", *argv]
    if not argv or argv[0] != "init":
        raise ConfigError("keys", argv[0] if argv else "", "must be init: tenuto keys init DIR")
    description = "Make an authority, a certificate for each role, and the key that signs policies."
    options = parse(InitOptions, argv[1:], prog="tenuto keys init", description=description)
    make(options.directory, options.host, days=options.days, now=datetime.now(UTC))
    _tell(options.directory)
    return DONE


def make(directory: Path, hosts: Sequence[str] = (), *, days: int = 365, now: datetime) -> None:
    """Make all keys below `directory`. A failure leaves nothing behind.

    Args:
        directory: must not exist.
        hosts: names or addresses for the certificates, besides this machine's own of the loopback.
        days: how long they are valid.
        now: from when.

    Raises:
        ConfigError: an argument is wrong, or the directory cannot be made.
    """
    if not 1 <= days <= 36_500:
        raise ConfigError("days", days, "must be in 1..36500")
    names = [_general_name(host) for host in dict.fromkeys((*LOCAL, *hosts))]
    if os.path.lexists(directory):
        raise ConfigError("directory", str(directory), "must not exist yet")
    try:
        # Made beside it and renamed: there are all keys or none.
        directory.absolute().parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as undo:
            aside = Path(tempfile.mkdtemp(prefix=f".{directory.name}.", dir=directory.absolute().parent))
            undo.callback(shutil.rmtree, aside)
            _fill(aside, names, now - SLACK, now + timedelta(days=days))
            aside.rename(directory)
            undo.pop_all()
    except OSError as error:
        raise ConfigError(
            "directory", str(directory), f"must be a path to write to ({error.strerror})"
        ) from error


def _fill(home: Path, hosts: list[x509.GeneralName], first: datetime, last: datetime) -> None:
    authority_key = ec.generate_private_key(ec.SECP256R1())
    authority = _authority(authority_key, first, last)
    (home / AUTHORITY_HOME).mkdir(mode=0o700)
    _write_key(home / AUTHORITY_HOME / AUTHORITY_KEY, authority_key)
    _write(home / AUTHORITY_HOME / AUTHORITY, _pem(authority))
    policy_key = ed25519.Ed25519PrivateKey.generate()
    for role in ROLES:
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _certificate(role, key, hosts, authority, authority_key)
        folder = home / role
        folder.mkdir(mode=0o700)
        _write_key(folder / KEY, key)
        _write(folder / CERTIFICATE, _pem(certificate))
        _write(folder / AUTHORITY, _pem(authority))
        _write(folder / POLICY_PUBLIC, _public_pem(policy_key))
    _write_key(home / LEARNER / POLICY_KEY, policy_key)


def _authority(key: ec.EllipticCurvePrivateKey, first: datetime, last: datetime) -> x509.Certificate:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "tenuto ca")])
    usage = _usage(signs_certificates=True)
    return (
        _builder(name, name, key, first, last)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


def _certificate(
    role: str,
    key: ec.EllipticCurvePrivateKey,
    hosts: list[x509.GeneralName],
    authority: x509.Certificate,
    authority_key: ec.EllipticCurvePrivateKey,
) -> x509.Certificate:
    """For both ends of a link: a process listens to some of the others and connects to the rest."""
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, role)])
    first, last = authority.not_valid_before_utc, authority.not_valid_after_utc
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key())
    return (
        _builder(name, authority.subject, key, first, last)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(both), critical=False)
        .add_extension(x509.SubjectAlternativeName(hosts), critical=False)
        .add_extension(issuer, critical=False)
        .sign(authority_key, hashes.SHA256())
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, first: datetime, last: datetime
) -> x509.CertificateBuilder:
    return x509.CertificateBuilder(
        issuer_name=issuer,
        subject_name=subject,
        public_key=key.public_key(),
        serial_number=x509.random_serial_number(),
        not_valid_before=first,
        not_valid_after=last,
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not _HOST_NAME.fullmatch(host) or len(host) > 253:
        raise ConfigError("host", host, "must be a host's name or address, without a port")
    return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _public_pem(key: ed25519.Ed25519PrivateKey) -> bytes:
    return key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def _write_key(path: Path, key: PrivateKey) -> None:
    data = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    _write(path, data, mode=0o600)


def _write(path: Path, data: bytes, mode: int = 0o644) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)  # never open to others, even once
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)


def _tell(directory: Path) -> None:
    say = Console(highlight=False, soft_wrap=True).print
    say(f"made {directory}")
    for role in ROLES:
        signs = f", {POLICY_KEY}: signs policies" if role == LEARNER else ""
        say(f"  {role + '/':<15} {CERTIFICATE}, {KEY}, {AUTHORITY}, {POLICY_PUBLIC}{signs}")
    say(f"  {AUTHORITY_HOME + '/':<15} {AUTHORITY_KEY}: issues certificates; no process needs it")
    say("Copy to each host, keeping the modes, only the directories of the processes that run there;")
    say("operator/ to where you type tenuto run, status, hold, resume, schedule or stop.")
    say(f"Keep {directory / AUTHORITY_HOME} somewhere else. Start every process with --link.secure DIR.")
