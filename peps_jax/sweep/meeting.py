"""How the processes of a sweep come together: process 0 holds a roll call at the coordinator's address.

The others call there and say which they are; when all have come, process 0 gives each the same name of this run, and the
connections end. A message is a line of JSON. Everybody who waits says for whom, and ends in one line when the time is up.

It takes the place of `jax.distributed.initialize`, which ends a process that waited too long with a C++ stack, can't tell who is
missing, and makes a process count the others' devices for ever. JAX is only asked for the settings of Slurm and other clusters.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import selectors
import socket
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from peps_jax.execution.waiting import Reminder
from peps_jax.sweep.workers import Team, numbered

WAIT = 300.0  # s for all processes to come, unless told otherwise
PAUSE = 0.5  # s between two attempts to reach process 0
ATTEMPT = 5.0  # s for an attempt
LONGEST = 4096  # bytes of a caller's first message; who sends more is somebody else


class Place(NamedTuple):
    """Where the processes meet, and which one this is."""

    coordinator: str  # host:port of process 0
    count: int
    index: int
    accelerators: str = ""  # that this one may use, where a cluster gives each process its own

    @property
    def host(self) -> str:
        return self.coordinator.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        return int(self.coordinator.rpartition(":")[2])


# --- settings -------------------------------------------------------------------------------------------------------------


def find(coordinator: str | None = None, count: int | None = None, index: int | None = None) -> Place:
    """The place of this process. What is None is found in the settings of Slurm or another cluster.

    Raises:
      ValueError: something is missing there, or makes no sense.
    """
    with Reminder("waiting for the cluster's settings"):
        try:
            coordinator, count, index, local = _detected(coordinator, count, index)
        except Exception as error:  # whatever a cluster's settings may lack
            raise ValueError(
                f"the cluster's settings can't be read: {error or type(error).__name__}; {BY_HAND}"
            ) from None
    for name, value in {
        "the coordinator": coordinator,
        "the number of processes": count,
        "its own number": index,
    }.items():
        if value is None:
            raise ValueError(f"this process can't join the others, for no cluster tells it {name}: {BY_HAND}")
    return Place(str(coordinator), int(count), int(index), ",".join(map(str, local or ())))


BY_HAND = "without a cluster that JAX knows, give every process --coordinator HOST:PORT, --processes and --process"


def _detected(coordinator: str | None, count: int | None, index: int | None) -> tuple[Any, Any, Any, Any]:
    """Coordinator, count, index and local devices as `jax.distributed.initialize` would find them."""
    from jax._src.clusters import ClusterEnv  # public only as a part of that

    coordinator = coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS")
    named = os.environ.get("JAX_LOCAL_DEVICE_IDS")
    local = named.split(",") if named else None
    if None not in (coordinator, count, index, local):
        return coordinator, count, index, local
    return ClusterEnv.auto_detect_unset_distributed_params(coordinator, count, index, local, None, int(WAIT))


def use_own_accelerators(place: Place) -> None:
    """Keeps JAX to the accelerators that are this process's. Before JAX meets its devices."""
    if place.accelerators:
        import jax

        jax.config.update("jax_cuda_visible_devices", place.accelerators)
        jax.config.update("jax_rocm_visible_devices", place.accelerators)


# --- roll call ------------------------------------------------------------------------------------------------------------


def join(place: Place, wait: float = WAIT) -> Team:
    """Waits until all processes are there, `wait` seconds at most.

    Raises:
      ValueError: they don't come together; one line says who is missing, where, and what to look at.
    """
    if place.count == 1:
        return Team(run=_new_run(), accelerators=place.accelerators)
    run, neighbours = RollCall(place, wait).hold() if place.index == 0 else Call(place, wait).make()
    return Team(place.index, place.count, run, neighbours, place.accelerators)


def _new_run() -> str:
    return os.urandom(8).hex()


def _line(message: Mapping[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


class RollCall:
    """Process 0's part: it listens until all have come."""

    def __init__(self, place: Place, wait: float):
        self._place, self._wait = place, wait
        self._present: dict[int, socket.socket] = {}
        self._hosts = {0: socket.gethostname()}
        self._heard: dict[socket.socket, bytes] = {}  # of those who haven't said yet which they are
        self._selector = selectors.DefaultSelector()
        self._told, self._told_at = (0, ""), 0.0  # of who is missing, and when

    @property
    def missing(self) -> list[int]:
        """Processes that haven't come, or have left again."""
        return [index for index in range(1, self._place.count) if index not in self._present]

    def hold(self) -> tuple[str, int]:
        """The run's name, and how many processes are on this machine. Raises ValueError when the time is up."""
        end = time.monotonic() + self._wait
        with self._selector, _door(self._place) as door, contextlib.closing(self):
            self._selector.register(door, selectors.EVENT_READ)
            with Reminder(lambda: f"process 0 waits at {self._place.coordinator} for {numbered(self.missing)}"):
                while self.missing:
                    left = end - time.monotonic()
                    if left <= 0:
                        raise ValueError(self._give_up())
                    self._tell_who_is_missing()
                    for key, _ in self._selector.select(min(left, PAUSE)):
                        if key.fileobj is door:
                            self._welcome(door)
                        else:
                            self._listen(key.fileobj)
            return self._tell_all()

    def close(self) -> None:
        """Ends all connections."""
        for caller in [*self._present.values(), *self._heard]:
            caller.close()

    def _welcome(self, door: socket.socket) -> None:
        with contextlib.suppress(OSError):  # who was at the door has left
            caller, _ = door.accept()
            caller.settimeout(ATTEMPT)
            self._heard[caller] = b""
            self._selector.register(caller, selectors.EVENT_READ)

    def _listen(self, caller: socket.socket) -> None:
        """Reads what somebody says: which process it is, or that it leaves."""
        try:
            said = caller.recv(LONGEST)
        except OSError:
            said = b""
        if caller not in self._heard:  # it has said all that it had to say
            if not said:
                self._leave(caller)
            return
        self._heard[caller] += said
        if not said or len(self._heard[caller]) > LONGEST:
            self._leave(caller)
        elif b"\n" in self._heard[caller]:
            self._introduce(caller, self._heard.pop(caller))

    def _introduce(self, caller: socket.socket, said: bytes) -> None:
        try:
            told = json.loads(said)
            index, count, host = int(told["process"]), int(told["processes"]), str(told["host"])
        except (ValueError, KeyError, TypeError):  # no process of a sweep
            self._leave(caller)
            return
        reason = ""
        if count != self._place.count:
            reason = f"it says that there are {count} processes, process 0 that there are {self._place.count}"
        elif not 1 <= index < count:
            reason = f"there is no process {index} of {count}"
        elif index in self._present:
            reason = f"another process {index} is there already"
        if reason:
            self._say(caller, {"refused": reason})
            self._leave(caller)
            return
        self._present[index], self._hosts[index] = caller, host

    def _leave(self, caller: socket.socket) -> None:
        self._selector.unregister(caller)
        self._heard.pop(caller, None)
        self._present = {index: one for index, one in self._present.items() if one is not caller}
        caller.close()

    def _say(self, caller: socket.socket, message: Mapping[str, Any]) -> None:
        with contextlib.suppress(OSError):  # whoever has left is noticed when it is listened to
            caller.sendall(_line(message))

    def _tell_who_is_missing(self) -> None:
        """Now and then, if it isn't what was told last."""
        told = len(self._present), numbered(self.missing)
        if told != self._told and time.monotonic() - self._told_at > PAUSE:
            self._told, self._told_at = told, time.monotonic()
            for caller in self._present.values():
                self._say(caller, {"missing": told[1]})

    def _tell_all(self) -> tuple[str, int]:
        run, on = _new_run(), Counter(self._hosts[index] for index in range(self._place.count))
        for index, caller in self._present.items():
            self._say(caller, {"run": run, "neighbours": on[self._hosts[index]]})
        return run, on[self._hosts[0]]

    def _give_up(self) -> str:
        reason = f"{numbered(self.missing)} of {self._place.count} didn't come to {self._place.coordinator} in {self._wait:g} s"
        for caller in self._present.values():
            self._say(caller, {"refused": reason})
        return f"{reason}; see what they say, and that they reach that address (--wait says how long to wait)"


def _door(place: Place) -> socket.socket:
    """Where the others call. Raises ValueError if this process can't listen there."""
    try:
        with contextlib.suppress(OSError):  # no IPv6
            return socket.create_server(("", place.port), family=socket.AF_INET6, dualstack_ipv6=True, backlog=1024)
        return socket.create_server(("", place.port), backlog=1024)
    except (OSError, OverflowError) as error:
        raise ValueError(
            f"process 0 can't listen on port {place.port} of {socket.gethostname()}: {_reason(error)}; choose another port "
            "for --coordinator"
        ) from None


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


class Call:
    """Another process's part: it calls process 0, again and again, until that says that all have come."""

    def __init__(self, place: Place, wait: float):
        self._place, self._wait = place, wait
        self._end = 0.0  # on the clock
        self._obstacle = f"process 0 isn't reached at {place.coordinator}"

    def make(self) -> tuple[str, int]:
        """The run's name, and how many processes are on this machine. Raises ValueError when the time is up."""
        self._end = time.monotonic() + self._wait
        with Reminder(lambda: f"process {self._place.index} waits: {self._obstacle}"):
            while self._left() > 0:
                try:
                    address = (self._place.host, self._place.port)
                    with socket.create_connection(address, min(ATTEMPT, self._left())) as line:
                        return self._listen(line)
                except OverflowError as error:
                    raise ValueError(f"coordinator {self._place.coordinator!r} has no such port: {error}") from None
                except OSError as error:
                    if not isinstance(error, TimeoutError) or "reached" in self._obstacle:
                        self._obstacle = f"process 0 isn't reached at {self._place.coordinator} ({_reason(error)})"
                time.sleep(max(0.0, min(PAUSE, self._left())))
        raise ValueError(
            f"process {self._place.index} gave up after {self._wait:g} s: {self._obstacle}; see that all processes run, that "
            "--coordinator names the machine of process 0, and that nothing closes the port (--wait says how long to wait)"
        )

    def _left(self) -> float:
        return self._end - time.monotonic()

    def _listen(self, line: socket.socket) -> tuple[str, int]:
        """What process 0 says in the end. Raises OSError if it goes before."""
        if line.getsockname() == line.getpeername():  # nobody listens, and the system gave this end the very port
            raise OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
        about = {"process": self._place.index, "processes": self._place.count, "host": socket.gethostname()}
        line.sendall(_line(about))
        self._obstacle = f"not all have come to {self._place.coordinator}"
        with line.makefile("rb") as messages:
            while True:
                line.settimeout(max(0.001, self._left()))
                said = messages.readline(LONGEST)
                if not said:
                    raise OSError("it was there, and left")
                told = self._understood(said)
                if "missing" in told:
                    self._obstacle = f"{told['missing']} didn't come to {self._place.coordinator} yet"
                elif "refused" in told:
                    raise ValueError(f"process 0 refused process {self._place.index}: {told['refused']}")
                else:
                    return str(told["run"]), int(told["neighbours"])

    def _understood(self, said: bytes) -> dict[str, Any]:
        try:
            told = json.loads(said)
            if told.keys() & {"missing", "refused", "run"}:
                return told
        except (ValueError, AttributeError):
            pass
        raise ValueError(
            f"what answers at {self._place.coordinator} is no process 0 of a sweep, but says {said[:40]!r}: choose another port"
        )
