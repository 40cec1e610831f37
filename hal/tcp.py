"""TCP connections with a deadline that includes the lookup of the host's name."""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
from concurrent.futures import Future, wait
from typing import Any

from hal.deadline import SLICE_S, Deadline

_Places = list[tuple[Any, ...]]
_turn = threading.Lock()
_looked_up: dict[tuple[str, int], Future[_Places]] = {}
"""Lookups that are running."""


def connected(host: str, port: int, deadline: Deadline) -> socket.socket:
    """A socket, not blocking, connected to the first of the host's addresses that answers.

    Raises
    ------
    OSError    the host has no address, or no program listens there; TimeoutError: no connection before the deadline
    Cancelled  asked to stop
    """
    places = _places(host, port, deadline)
    failure = OSError(errno.EHOSTUNREACH, os.strerror(errno.EHOSTUNREACH))
    for number, place in enumerate(places):
        try:
            # With several addresses, each gets its share of the time.
            return _connected(place, deadline.within(deadline.left_s() / (len(places) - number)))
        except OSError as error:
            failure = error
    raise failure


def _places(host: str, port: int, deadline: Deadline) -> _Places:
    """The result of ``getaddrinfo``, on another thread, because without a name server it may wait for half a minute."""
    try:
        return list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST))
    except socket.gaierror:  # a name
        found = _begun(host, port)
    except ValueError as error:
        raise OSError(errno.EINVAL, f"{host!r} is not a valid host name") from error
    while not wait((found,), min(SLICE_S, deadline.left_s())).done:
        _still_time(deadline)
    return found.result()


def _begun(host: str, port: int) -> Future[_Places]:
    """The lookup of a name; only one at a time for each name, even if callers give up."""

    def resolve() -> None:
        try:
            found.set_result(list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)))
        except OSError as error:
            found.set_exception(error)
        finally:
            with _turn:
                del _looked_up[host, port]

    with _turn:
        if (host, port) in _looked_up:
            return _looked_up[host, port]
        found = _looked_up[host, port] = Future()
    threading.Thread(target=resolve, name="names", daemon=True).start()
    return found


def _connected(place: tuple[Any, ...], deadline: Deadline) -> socket.socket:
    family, kind, protocol, _, address = place
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        failure = connection.connect_ex(address)
        if failure == errno.EINPROGRESS:
            while not select.select([], [connection], [], min(SLICE_S, deadline.left_s()))[1]:
                _still_time(deadline)
            failure = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if failure:
            raise OSError(failure, os.strerror(failure))
    except BaseException:
        connection.close()
        raise
    return connection


def _still_time(deadline: Deadline) -> None:
    deadline.sleep(0.0)  # a cancelled call ends soon
    if deadline.passed:
        raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
