"""Secrets in files: the tokens of links that stay the same, and certificates."""

import contextlib
import datetime
import hashlib
import ipaddress
import os
import secrets
import socket
import ssl
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slviewer.errors import SlviewerError, UsageError
from slviewer.server.access import ROLES, Role
from slviewer.server.binding import network_address
from slviewer.session.atomic import rename
from slviewer.session.reading import open_regular

_MOST_BYTES = 4096
_VALID_DAYS = 397
"""Validity of a self-made certificate: browsers refuse longer ones."""
_RENEWED_BEFORE = datetime.timedelta(days=30)


def load_tokens(path: Path) -> dict[Role, str]:
    """The tokens by role in a TOML file; a file that does not exist is made, with random ones for
    all roles.

    Raises UsageError for a file that others can read, or that holds anything else.
    """
    if not path.exists():
        tokens: dict[Role, str] = {role: secrets.token_urlsafe(24) for role in ROLES}
        save_tokens(path, tokens)
        return tokens
    try:
        with open_regular(path) as file:
            if os.name == "posix" and os.fstat(file.fileno()).st_mode & 0o077:
                raise UsageError(f"Others can read the tokens in {path}", f"run chmod 600 {path}.")
            given = tomllib.loads(file.read(_MOST_BYTES).decode())
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read ({error})", "give a TOML file with the tokens."
        ) from error
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{path} is not a TOML file with tokens, such as operate = '...': {error}."
        ) from error
    if (
        not given
        or not given.keys() <= set(ROLES)
        or not all(isinstance(token, str) for token in given.values())
    ):
        raise UsageError(
            f"{path} must hold tokens of the roles {', '.join(ROLES)}, such as operate = '...'."
        )
    return {role: given[role] for role in ROLES if role in given}


def save_tokens(path: Path, tokens: Mapping[Role, str]) -> None:
    """Replace a file of tokens by one that only this user can read."""
    _write_private(
        path, "".join(f'{role} = "{token}"\n' for role, token in tokens.items()).encode()
    )


@dataclass(frozen=True)
class TlsCertificate:
    """A certificate with the files of its chain and its private key (PEM); `self_made`: browsers do
    not trust it."""

    chain: Path
    key: Path
    self_made: bool = False

    def context(self) -> ssl.SSLContext:
        """The server's settings for TLS 1.2 and later. Raises SlviewerError where the files cannot
        be used."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2

        def refuse_passphrase() -> str:
            """Raise SlviewerError in place of a question on the terminal."""
            raise SlviewerError(f"{self.key} is encrypted", "give a key without a passphrase.")

        try:
            for path in (self.chain, self.key):
                open_regular(path).close()  # of a pipe or a device, OpenSSL would wait for the end
            context.load_cert_chain(self.chain, self.key, refuse_passphrase)
        except (OSError, ValueError) as error:
            raise SlviewerError(
                f"{self.chain} and {self.key} cannot be used for TLS ({error})",
                "give a certificate and its key, as PEM.",
            ) from error
        return context

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the certificate, as browsers show it."""
        text = self.chain.read_text("ascii")
        end = "-----END CERTIFICATE-----"
        first = text[text.index("-----BEGIN CERTIFICATE-----") :].partition(end)[0] + end
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first)).digest().hex(":").upper()


def self_made_certificate(
    host: str, names: tuple[str, ...], folder: Path | None = None
) -> TlsCertificate:
    """The certificate that slviewer made for itself: the same at every start, until its names or
    dates do not fit.

    Raises SlviewerError where the package cryptography is missing, and OSError where it cannot be
    saved.
    """
    try:
        from cryptography import x509
    except ImportError as error:
        raise SlviewerError(
            "A certificate is made by the package cryptography",
            "install it with pip install 'slviewer[tls]', or give a certificate and its key with"
            " --tls-files.",
        ) from error
    folder = folder or _config_folder()
    certificate = TlsCertificate(
        folder / "tls-certificate.pem", folder / "tls-key.pem", self_made=True
    )
    wanted = _list_names(host, names)
    with contextlib.suppress(OSError, ValueError, x509.ExtensionNotFound):
        stored = x509.load_pem_x509_certificate(certificate.chain.read_bytes())
        stored_names = stored.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        held = {
            str(value)
            for kind in (x509.DNSName, x509.IPAddress)
            for value in stored_names.get_values_for_type(kind)
        }
        fresh = stored.not_valid_after_utc - datetime.datetime.now(datetime.UTC) > _RENEWED_BEFORE
        if fresh and wanted <= held and certificate.key.exists():
            return certificate
    _make_certificate(certificate, wanted)
    return certificate


def _list_names(host: str, names: tuple[str, ...]) -> set[str]:
    """The host names and addresses under which browsers may reach this machine."""
    machine = socket.gethostname().lower()
    given = {name.lower().rpartition(":")[0] or name.lower() for name in names}
    wanted = {"localhost", "127.0.0.1", "::1", machine, f"{machine}.local", *given}
    with contextlib.suppress(ValueError):
        address = ipaddress.ip_address(host)
        wanted |= (
            {str(address)}
            if not address.is_unspecified
            else {found}
            if (found := network_address())
            else set()
        )
    return wanted


def _make_certificate(certificate: TlsCertificate, names: set[str]) -> None:
    """Make a key and a certificate for these names, signed by itself."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "slviewer")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=_VALID_DAYS))
        .add_extension(
            x509.SubjectAlternativeName([_general_name(one) for one in sorted(names)]),
            critical=False,
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([x509.ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
        .sign(key, hashes.SHA256())
    )
    certificate.key.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    _write_private(certificate.key, private)
    _write_private(certificate.chain, made.public_bytes(serialization.Encoding.PEM))


def _general_name(name: str) -> Any:
    """A host name or an address, as certificates hold it."""
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _config_folder() -> Path:
    """The folder of this user's settings of slviewer, where the self-made certificate is stored."""
    if sys.platform == "win32":
        base = os.environ.get("APPDATA", "~")
    elif sys.platform == "darwin":
        base = "~/Library/Application Support"
    else:
        base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(os.path.expanduser(base), "slviewer")


def _write_private(path: Path, content: bytes) -> None:
    """Replace a file at once by one that only this user can read."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with os.fdopen(
            os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb"
        ) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
