"""Who may do what on the server: enforced in the session, whatever the connection.

asyncua's own rules hang on the secure channel, and do not hold where a client opens none: it takes unsecured messages
even where no unsecured endpoint is offered, lets any connection take over a session whose (consecutive) token it
guesses, checks a client's certificate only where the client shows it a second time, and lets anybody register servers.
So each session here asks for itself.
"""

from __future__ import annotations

import logging
import time
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import PermissionRuleset, User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from cryptography import x509

from straightcomp_ros.opcua.users import OPERATOR, Users

_log = logging.getLogger(__name__)
_FASTEST_PUBLISHING_MS = 50.0
_MOST_SUBSCRIPTIONS = 5
_MOST_MONITORED_ITEMS = 200
_LOGINS_PER_S = 5.0
_LOGINS_AT_ONCE = 20.0


class Access:
    """Decides over connections and users.

    Args:
        users: who may log in.
        encrypted: whether only signed and encrypted channels will do.
        trust: certificates of the clients that may connect; None: any.
    """

    def __init__(self, users: Users, *, encrypted: bool, trust: TrustStore | None = None) -> None:
        self._users, self._encrypted, self._trust = users, encrypted, trust
        self._logins, self._refilled = _LOGINS_AT_ONCE, time.monotonic()

    def check_channel(self, certificate: bytes | None) -> None:
        """Raise ServiceError if a session may not live on a channel of this client ``certificate`` (DER); an
        unsecured channel has none."""
        if not self._encrypted:
            return
        if not certificate:
            raise ServiceError(ua.StatusCodes.BadSecurityModeInsufficient)
        if self._trust is not None and not self._trust.validate(x509.load_der_x509_certificate(certificate)):
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)

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
        if self._logins < 1.0:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        self._logins -= 1.0


class LeftToTheSession(PermissionRuleset):
    """Rules of the secure channel: all is allowed there, since :class:`GuardedSession` decides."""

    def check_validity(self, user: User, action_type: Any, body: Any) -> bool:
        """Always."""
        return True


class GuardedServer(InternalServer):
    """asyncua's server with sessions that guard themselves."""

    def __init__(self, access: Access) -> None:
        super().__init__(user_manager=access)
        self.access = access

    def create_session(self, name: str, user: User | None = None, external: bool = False) -> InternalSession:
        """A session of a client."""
        return GuardedSession(
            self,
            self.aspace,
            self.subscription_service,
            name,
            user=user or User(role=UserRole.Anonymous),
            external=external,
        )

    def lookup_external_session(self, auth_token: ua.NodeId) -> InternalSession | None:
        """None: nobody takes over a session; who lost the connection logs in again."""
        return None

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refused: this is no discovery server."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


class GuardedSession(InternalSession):
    """A client's session: anybody who was let in reads, operators call methods, nobody writes or changes nodes."""

    iserver: GuardedServer
    _items = 0

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Log in."""
        self.iserver.access.check_channel(peer_certificate)
        return super().activate_session(params, peer_certificate)

    async def close_session(self, delete_subs: bool = True) -> None:
        """Log out. Subscriptions end too: nobody could take them over."""
        await super().close_session(True)

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Methods: operators only."""
        if self.user.role is not UserRole.User:
            raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        return await super().call(params)

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Refused, each."""
        return [ua.StatusCode(ua.StatusCodes.BadUserAccessDenied) for _ in params.NodesToWrite]

    async def _refuse(self, *_: Any) -> Any:
        raise ServiceError(ua.StatusCodes.BadUserAccessDenied)

    add_nodes = delete_nodes = add_references = delete_references = _refuse
    history_update = transfer_subscriptions = _refuse

    async def create_subscription(self, params: ua.CreateSubscriptionParameters, *rest: Any, **options: Any) -> Any:
        """As many and as fast as the values are."""
        if len(self._own_subscriptions()) >= _MOST_SUBSCRIPTIONS:
            raise ServiceError(ua.StatusCodes.BadTooManySubscriptions)
        params.RequestedPublishingInterval = max(params.RequestedPublishingInterval, _FASTEST_PUBLISHING_MS)
        return await super().create_subscription(params, *rest, **options)

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        """The session's own only."""
        self._check_own(params.SubscriptionId)
        params.RequestedPublishingInterval = max(params.RequestedPublishingInterval, _FASTEST_PUBLISHING_MS)
        return super().modify_subscription(params)

    async def delete_subscriptions(self, ids: list[int]) -> list[ua.StatusCode]:
        """The session's own only."""
        for subscription in ids:
            self._check_own(subscription)
        return await super().delete_subscriptions(ids)

    async def set_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[ua.StatusCode]:
        """The session's own only."""
        for subscription in params.SubscriptionIds:
            self._check_own(subscription)
        return await super().set_publishing_mode(params)

    def republish(self, params: ua.RepublishParameters) -> ua.NotificationMessage:
        """The session's own only."""
        self._check_own(params.SubscriptionId)
        return super().republish(params)

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """In the session's own subscriptions, and not without end."""
        self._check_own(params.SubscriptionId)
        self._items += len(params.ItemsToCreate)
        if self._items > _MOST_MONITORED_ITEMS:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    async def delete_monitored_items(self, params: ua.DeleteMonitoredItemsParameters) -> list[ua.StatusCode]:
        """The session's own only."""
        self._check_own(params.SubscriptionId)
        results = await super().delete_monitored_items(params)
        self._items -= sum(result.is_good() for result in results)
        return results

    def _own_subscriptions(self) -> list[int]:
        every = self.subscription_service.subscriptions
        return [number for number, subscription in every.items() if subscription.session_id == self.session_id]

    def _check_own(self, subscription: int) -> None:
        if subscription not in self._own_subscriptions():
            raise ServiceError(ua.StatusCodes.BadSubscriptionIdInvalid)
