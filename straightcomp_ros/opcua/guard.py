"""What each user may do on the server: enforced in the session, whatever the connection.

asyncua ties its rules to the secure channel. A client that opens none escapes them: asyncua takes unsecured messages
even where no unsecured endpoint is offered, lets any connection take over a session whose (consecutive) token it
guesses, checks a client's certificate only where the client shows it twice, and lets any client register servers.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import PermissionRuleset, User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from cryptography import x509

from straightcomp_ros.opcua.admission import OPERATOR, Users

_log = logging.getLogger(__name__)
_FASTEST_PUBLISHING_MS = 50.0
_MOST_SUBSCRIPTIONS = 5
_MOST_MONITORED_ITEMS = 200
_LOGINS_PER_S = 5.0
_LOGINS_AT_ONCE = 20.0
_PAUSE_S = 1.0
"""After a refused login, on the same connection."""


def _refuse(status: int, refused: object = True) -> None:
    if refused:
        raise ServiceError(status)


class Access:
    """Decides who may connect (with ``encrypted``: signed and encrypted, with a certificate that ``trust`` holds, where
    there is one) and who may log in."""

    def __init__(self, users: Users, *, encrypted: bool, trust: TrustStore | None = None) -> None:
        self._users, self._encrypted, self._trust = users, encrypted, trust
        self._logins, self._refilled = _LOGINS_AT_ONCE, time.monotonic()

    def check_channel(self, certificate: bytes | None) -> None:
        """Raise ServiceError if a client with this certificate (DER; None: unsecured channel) may have no session."""
        _refuse(ua.StatusCodes.BadSecurityModeInsufficient, self._encrypted and not certificate)
        if self._encrypted and certificate and self._trust is not None:
            trusted = self._trust.validate(x509.load_der_x509_certificate(certificate))
            _refuse(ua.StatusCodes.BadCertificateUntrusted, not trusted)

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> User | None:
        """The user with this name and password; None refuses. asyncua's interface of a user manager."""
        if username is None:
            # Only where anonymous tokens are accepted at all.
            return User(role=UserRole.Anonymous)
        self._take_login()
        role = self._users.role(username, password or "")
        if role is None:
            _log.warning("login of user %r refused", username)
            return None
        return User(role=UserRole.User if role == OPERATOR else UserRole.Anonymous, name=username)

    def _take_login(self) -> None:
        """Each login costs 50 ms of CPU: a flood of them must not take more than a quarter of a core."""
        now = time.monotonic()
        self._logins = min(_LOGINS_AT_ONCE, self._logins + (now - self._refilled) * _LOGINS_PER_S)
        self._refilled = now
        _refuse(ua.StatusCodes.BadTooManyOperations, self._logins < 1.0)
        self._logins -= 1.0


class LeftToTheSession(PermissionRuleset):
    """Rules of the secure channel: everything is allowed there, since :class:`GuardedSession` decides."""

    def check_validity(self, user: User, action_type: Any, body: Any) -> bool:
        return True


class GuardedServer(InternalServer):
    """asyncua's server with sessions that guard themselves."""

    def __init__(self, access: Access) -> None:
        super().__init__(user_manager=access)
        self.access = access
        self.refused_until: dict[str, float] = {}
        self._closing: set[asyncio.Future[None]] = set()

    def create_session(self, name: str, user: User | None = None, external: bool = False) -> InternalSession:
        """A session, of an external client in the place of the one that its connection (``name``) had before: asyncua
        would keep that for ten minutes, and a thousand of them keep everyone out."""
        for former in [one for one in self._external_sessions.values() if one.name == name]:
            closing = asyncio.ensure_future(former.close_session())
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)
        user = user or User(role=UserRole.Anonymous)
        return GuardedSession(self, self.aspace, self.subscription_service, name, user=user, external=external)

    def lookup_external_session(self, auth_token: ua.NodeId) -> InternalSession | None:
        """None: no client takes over a session; one that lost its connection logs in again."""
        return None

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refused: this is no discovery server."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


def _own_only(method: Callable[..., Any], subscriptions: Callable[[Any], Sequence[int]]) -> Any:
    """``method`` of a session, refused where its parameters name a subscription of another session."""

    def guarded(self: GuardedSession, params: Any) -> Any:
        for number in subscriptions(params):
            self.check_own(number)
        return method(self, params)

    return guarded


def _of_one(params: Any) -> list[int]:
    return [params.SubscriptionId]


class GuardedSession(InternalSession):
    """A client's session: every admitted client reads, operators call methods, none writes or changes nodes.

    Subscriptions are bounded in number and speed, and only the session that made one can change, use or end it.
    """

    iserver: GuardedServer

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        self.iserver.access.check_channel(peer_certificate)
        # One connection must not use up the logins of all.
        now, refused = time.monotonic(), self.iserver.refused_until
        _refuse(ua.StatusCodes.BadTooManyOperations, now < refused.get(self.name, now))
        try:
            return super().activate_session(params, peer_certificate)
        except (ServiceError, ua.UaError):
            for name in [name for name, until in refused.items() if until < now]:
                del refused[name]
            refused[self.name] = now + _PAUSE_S
            raise

    async def close_session(self, delete_subs: bool = True) -> None:
        """Subscriptions always end too: no client could take them over."""
        await super().close_session(True)

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        _refuse(ua.StatusCodes.BadUserAccessDenied, self.user.role is not UserRole.User)
        return await super().call(params)

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        return [ua.StatusCode(ua.StatusCodes.BadUserAccessDenied) for _ in params.NodesToWrite]

    async def _denied(self, *_: Any) -> Any:
        _refuse(ua.StatusCodes.BadUserAccessDenied)

    add_nodes = delete_nodes = add_references = delete_references = _denied
    history_update = transfer_subscriptions = _denied
    delete_subscriptions = _own_only(InternalSession.delete_subscriptions, lambda numbers: numbers)
    set_publishing_mode = _own_only(InternalSession.set_publishing_mode, lambda params: params.SubscriptionIds)
    republish = _own_only(InternalSession.republish, _of_one)
    modify_monitored_items = _own_only(InternalSession.modify_monitored_items, _of_one)
    set_monitoring_mode = _own_only(InternalSession.set_monitoring_mode, _of_one)
    delete_monitored_items = _own_only(InternalSession.delete_monitored_items, _of_one)

    async def create_subscription(self, params: ua.CreateSubscriptionParameters, *rest: Any, **options: Any) -> Any:
        _refuse(ua.StatusCodes.BadTooManySubscriptions, len(self._own_subscriptions()) >= _MOST_SUBSCRIPTIONS)
        params.RequestedPublishingInterval = max(params.RequestedPublishingInterval, _FASTEST_PUBLISHING_MS)
        return await super().create_subscription(params, *rest, **options)

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        self.check_own(params.SubscriptionId)
        params.RequestedPublishingInterval = max(params.RequestedPublishingInterval, _FASTEST_PUBLISHING_MS)
        return super().modify_subscription(params)

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        self.check_own(params.SubscriptionId)
        every = self.subscription_service.subscriptions
        items = sum(len(every[number].monitored_item_srv._monitored_items) for number in self._own_subscriptions())
        too_many = items + len(params.ItemsToCreate) > _MOST_MONITORED_ITEMS
        _refuse(ua.StatusCodes.BadTooManyMonitoredItems, too_many)
        return await super().create_monitored_items(params)

    def _own_subscriptions(self) -> list[int]:
        every = self.subscription_service.subscriptions
        return [number for number, subscription in every.items() if subscription.session_id == self.session_id]

    def check_own(self, subscription: int) -> None:
        """Raise ServiceError if this session has not made the subscription."""
        _refuse(ua.StatusCodes.BadSubscriptionIdInvalid, subscription not in self._own_subscriptions())
