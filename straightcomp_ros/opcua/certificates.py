"""The server's own certificate, and those of the clients that it trusts."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.truststore import TrustStore
from cryptography.x509.oid import ExtendedKeyUsageOID

from straightcomp_ros.contract import PACKAGE

CERTIFICATE, KEY = "certificate.der", "key.pem"


class CertificateError(ValueError):
    """Certificates cannot be made or read; the message says where and why."""


async def own_certificate(folder: str | Path, uri: str) -> tuple[Path, Path]:
    """Certificate (DER) and key (PEM) in ``folder``, made there (self-signed, for a year) if missing or expired.

    Raises:
        CertificateError: the folder cannot be written, or a file is no certificate or key.
    """
    certificate, key = Path(folder) / CERTIFICATE, Path(folder) / KEY
    before = os.umask(0o077)
    try:
        certificate.parent.mkdir(parents=True, exist_ok=True)
        usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        subject = {"organizationName": PACKAGE}
        await setup_self_signed_certificate(key, certificate, uri, socket.gethostname(), usage, subject)
    except (OSError, ValueError) as error:
        raise CertificateError(f"certificates in {folder}: {error}") from error
    finally:
        os.umask(before)
    return certificate, key


async def trusted_certificates(folder: str | Path) -> TrustStore:
    """Certificates in ``folder`` (.der, .pem): clients' own, or of issuers.

    Raises:
        CertificateError: no folder, none in it, or one that is none.
    """
    path = Path(folder)
    found = [file for file in path.glob("*.*") if file.suffix.lower() in (".der", ".pem")] if path.is_dir() else []
    if not found:
        raise CertificateError(f"trusted certificates: {folder} is no folder with .der or .pem files")
    trust = TrustStore([path], [])
    try:
        await trust.load_trust()
    except (OSError, ValueError) as error:
        raise CertificateError(f"trusted certificates in {folder}: {error}") from error
    return trust
