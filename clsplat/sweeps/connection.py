"""How a scheduler is reached: its certificates, and what is said where that fails."""

import logging
import ssl
from pathlib import Path

from clsplat.core.errors import ConfigError, DataError, DeviceError, one_line
from clsplat.core.reading import read_file
from clsplat.pipeline.execution import Execution, Tls

LOG = logging.getLogger("clsplat")


def require_certificates(tls: Tls) -> None:
    """Raise ConfigError where one cannot be read, or they do not belong together.  Dask would name no file."""
    for key in ("ca", "cert", "key"):
        try:
            read_file(Path(getattr(tls, key)))
        except DataError as error:
            raise ConfigError(f"tls.{key} (--tls-{key}): {error}") from error
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError as error:
        raise ConfigError(f"tls.ca (--tls-ca): {tls.ca}: expected a certificate in PEM ({error.reason})") from error
    try:
        context.load_cert_chain(tls.cert, tls.key, password=lambda: "")  # else it would ask in the terminal
    except (ssl.SSLError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise ConfigError(
            f"tls.cert, tls.key (--tls-cert, --tls-key): {tls.cert}, {tls.key}: expected a certificate in PEM and its "
            f"private key, without a password ({reason})"
        ) from error


def warn_of_open_port(execution: Execution) -> None:
    """Say so where a scheduler elsewhere is reached without TLS."""
    if execution.insecure:
        LOG.warning("%s: is not encrypted; whoever reaches the scheduler's port can run code", execution.engine)


def unanswered(execution: Execution, error: BaseException) -> DeviceError:
    """Return the error of a scheduler that cannot be reached."""
    reason = one_line(error.__cause__ or error) or "no answer"
    remedy = "start it with `dask scheduler`"
    if execution.tls:
        remedy += " and certificates of the authority that tls.ca (--tls-ca) names"
    return DeviceError(f"{execution.engine}: cannot be worked with ({reason}); {remedy}")
