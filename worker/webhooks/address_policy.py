"""The policy on addresses that webhooks may be sent to.

Clients choose the address, so it must not reach the service's own network: the host name is resolved once, each of its addresses
must be public or in an allowed network, and connections are only made to addresses that were checked.
"""

from __future__ import annotations

import ipaddress
import socket

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


class NotPublic(Exception):
    """The receiver's host name resolves to an address that webhooks may not be sent to."""


def resolve(host: str, port: int) -> list[Address]:
    """Return the addresses of a host name; an address is returned unchanged."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(ipaddress.ip_address(str(each[4][0]).partition("%")[0]) for each in found))


def checked_addresses(host: str, addresses: list[Address], networks: str) -> list[Address]:
    """Return the addresses to connect to, in the resolver's order.

    Raises
    ------
    NotPublic
        One of the addresses is not allowed, or there is none. The message omits the addresses, because clients can read the
        job's log and must not learn what internal names resolve to.
    """
    if not addresses or not all(may_reach(each, networks) for each in addresses):
        found = "an address that is not on the public internet" if addresses else "no address"
        raise NotPublic(f"{host} resolves to {found}.")
    return addresses


def may_reach(address: Address, networks: str = "") -> bool:
    """Return whether a webhook may be sent to an address: a public one, or one in an allowed network.

    An IPv6 address that embeds an IPv4 address (mapped, 6to4, NAT64, Teredo) is checked as the latter.
    """
    real = _embedded(address)
    if any(
        each in ipaddress.ip_network(network)
        for network in networks.split(",")
        if network
        for each in (address, real)
        if each.version == ipaddress.ip_network(network).version
    ):
        return True
    judged = {real} if _is_translated(address) else {address, real}
    return all(each.is_global and not each.is_multicast and not each.is_reserved for each in judged)


def _is_translated(address: Address) -> bool:
    """Return whether an IPv6 address only represents an IPv4 address and belongs to no network of its own."""
    return isinstance(address, ipaddress.IPv6Address) and (address.ipv4_mapped is not None or address in _NAT64)


def _embedded(address: Address) -> Address:
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    teredo = address.teredo
    return address.ipv4_mapped or address.sixtofour or (teredo[1] if teredo is not None else None) or address


def literal_address(host: str) -> Address | None:
    """Return the address if a host is written as one, None if it is a name."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
