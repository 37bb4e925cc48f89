"""The verb that serves a policy: drive-grpc."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Annotated

import tyro

from nurec_sim.cli.console import app, err
from nurec_sim.errors import NurecSimError

if TYPE_CHECKING:
    from nurec_sim.types import Policy


@app.command(name="drive-grpc")
def drive_grpc(
    policy: Annotated[str, tyro.conf.Positional],
    *,
    host: str = "127.0.0.1",
    port: int = 6789,
    sessions: int = 8,
    idle: float = 600.0,
    plan_timeout: float = 60.0,
    route_speed: float = 8.0,
    insecure: bool = False,
    allow_shut_down: bool = False,
) -> None:
    """Serve a policy over gRPC as the driver of AlpaSim's runtime, or of `run --policies grpc://HOST:PORT`.

    Prints `Serving on <host>:<port>` when ready; Ctrl-C stops. Each session has its own policy instance. The interface
    supports neither TLS nor tokens: remote clients require --insecure.

    Args:
        policy: a policy's name, my_policy.py:Class, or an entry point.
        host: address to listen on; default: localhost only.
        port: 0 selects a free one.
        sessions: maximum number of concurrent rollouts.
        idle: seconds after which a session without a call is closed.
        plan_timeout: seconds after which a policy that has not replied has failed.
        route_speed: m/s along routes of clients that send no speed, such as AlpaSim.
        insecure: accept any client that can reach the port.
        allow_shut_down: let clients stop the server with shut_down.
    """
    from nurec_sim.plugins import load_policy
    from nurec_sim.serving.driver import DriverOptions, DriverServer
    from nurec_sim.serving.server import check_exposure, run_until_signal

    logging.getLogger("nurec_sim").setLevel(logging.WARNING)
    check_exposure(host, protected=False, insecure=insecure)
    try:
        options = DriverOptions(
            max_sessions=sessions, idle_s=idle, plan_timeout_s=plan_timeout, route_speed_mps=route_speed,
            allow_shut_down=allow_shut_down,
        )  # fmt: skip
        made = [load_policy(policy)]
        if made[0].needs.privileged:
            err.print(f"note: {made[0].name} reads true actors, which only `nurec-sim run` sends", markup=False)

        def make() -> Policy:
            return made.pop() if made else load_policy(policy)

        run_until_signal(DriverServer(make, host, port, options=options))
    except (OSError, ValueError) as error:
        raise NurecSimError(str(error)) from None
