"""gRPC servers: the sensor server, and what any server of ours listens with."""

from nurec_sim.serving.calls import Service
from nurec_sim.serving.server.grpc_server import Application, GrpcServer, run_until_signal
from nurec_sim.serving.server.options import ServerOptions, Tls, check_exposure, is_loopback, read_token
from nurec_sim.serving.server.sensor_server import SensorServer
from nurec_sim.serving.server.telemetry import LogFormat, LogLevel, set_up_logging

__all__ = [
    "Application",
    "GrpcServer",
    "LogFormat",
    "LogLevel",
    "SensorServer",
    "ServerOptions",
    "Service",
    "Tls",
    "check_exposure",
    "is_loopback",
    "read_token",
    "run_until_signal",
    "set_up_logging",
]
