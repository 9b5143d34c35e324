"""Parameters of the OPC UA server."""

from dataclasses import dataclass

from straightcomp_ros.parameters.declaration import RefusedParameter, parameter

LOOPBACK = ("127.0.0.1", "::1", "localhost")
AUTO, NONE, ENCRYPTED = "auto", "none", "encrypted"


@dataclass(frozen=True)
class OpcuaParameters:
    """Where the server listens and whom it lets in."""

    host: str = parameter("127.0.0.1", "Address to listen on; 0.0.0.0 for all of this machine's addresses")
    port: int = parameter(4840, "TCP port to listen on", "[1, 65535]")
    security: str = parameter(
        AUTO,
        "encrypted: only signed and encrypted connections of known users; none: no encryption, anybody may read and "
        "known users may command, on the loopback interface only; auto: none on loopback, encrypted elsewhere",
        choices=(AUTO, NONE, ENCRYPTED),
    )
    users: str = parameter("", "File of users, made by `straightcomp opcua user`; empty: nobody may command")
    certificates: str = parameter(
        "", "Folder of the server's own certificate and key, made there where they are missing; for encryption"
    )
    trusted: str = parameter(
        "", "Folder of certificates (.der, .pem) of the clients, or of their issuers, that may connect; empty: any"
    )
    max_clients: int = parameter(
        20,
        "Largest number of connections at one time; one more closes the oldest that is no known user's",
        "[1, 1000]",
    )

    def __post_init__(self) -> None:
        if self.security == NONE and not self.on_loopback:
            raise RefusedParameter(
                "security",
                f"'none' is not allowed with '{{group}}host' '{self.host}'; "
                f"allowed: auto, encrypted, or a host of {', '.join(LOOPBACK)}",
            )
        if self.encrypted:
            for name, what in (("certificates", "a folder for the server's certificate"), ("users", "a file of users")):
                if not getattr(self, name):
                    raise RefusedParameter(name, f"is empty; with encryption it must name {what}")
        elif self.trusted:
            raise RefusedParameter("trusted", "needs encryption; allowed with '{group}security': encrypted")

    @property
    def on_loopback(self) -> bool:
        """Whether the server is reached from this machine only."""
        return self.host in LOOPBACK

    @property
    def encrypted(self) -> bool:
        """Whether connections must be signed and encrypted."""
        return self.security == ENCRYPTED or (self.security == AUTO and not self.on_loopback)

    @property
    def endpoint(self) -> str:
        """URL that clients connect to."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"opc.tcp://{host}:{self.port}/straightcomp/"
