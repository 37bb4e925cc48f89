"""Who may call a server: TLS, mutual TLS, tokens, addresses that other machines reach."""

import contextlib

import grpc
import pytest
import trustme
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving_calls import Stub, camera_message, refusal
from serving_world import camera_request, scene

from nurec_sim.errors import ServerError
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.server import SensorServer, ServerOptions, Tls, check_exposure, is_loopback, read_token
from nurec_sim.serving.server.options import shows_token
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import common

TOKEN = "a-long-secret-of-ours"


@pytest.fixture(scope="module")
def pem(tmp_path_factory):
    """PEM files: an authority, certificates of a server and a client that it signed, and a stranger's."""
    folder, authority, other = tmp_path_factory.mktemp("pem"), trustme.CA(), trustme.CA()
    authority.cert_pem.write_to_path(folder / "ca.pem")
    for name, issuer in (("server", authority), ("client", authority), ("stranger", other)):
        issued = issuer.issue_cert("localhost", "127.0.0.1")
        issued.cert_chain_pems[0].write_to_path(folder / f"{name}.pem")
        issued.private_key_pem.write_to_path(folder / f"{name}.key")
    return folder


@contextlib.contextmanager
def street_server(**options):
    with SensorServer(SceneStore([scene()], threads=1), port=0, server_options=ServerOptions(**options)) as address:
        yield address


def health_of(channel):
    return health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10).status


def test_tls_is_spoken_to_those_who_trust_the_authority(pem):
    with street_server(tls=Tls(pem / "server.pem", pem / "server.key")) as address:
        with RemoteSensors(address, "street", timeout_s=20, root_ca=pem / "ca.pem") as remote:
            assert remote.sense([camera_request("fish")])[0].rgb.shape == (90, 120, 3)
        with (
            RemoteSensors(address, "street", timeout_s=1, root_ca=pem / "stranger.pem") as remote,
            pytest.raises(ServerError),
        ):
            remote.scenes()
        with RemoteSensors(address, "street", timeout_s=1) as remote, pytest.raises(ServerError):
            remote.scenes()


def test_mutual_tls_wants_a_certificate_of_the_client(pem):
    def remote(name=None, timeout_s=1):
        cert, key = (pem / f"{name}.pem", pem / f"{name}.key") if name else (None, None)
        return RemoteSensors(address, timeout_s=timeout_s, root_ca=pem / "ca.pem", client_cert=cert, client_key=key)

    with street_server(tls=Tls(pem / "server.pem", pem / "server.key", client_ca=pem / "ca.pem")) as address:
        with remote("client", 20) as known:
            assert known.scenes() == ["clipgt-street"]
        for name in (None, "stranger"):
            with remote(name) as unknown, pytest.raises(ServerError):
                unknown.scenes()


@pytest.mark.parametrize(
    ("cert", "key", "ca"),
    [
        ("server.pem", "client.key", None),  # do not belong together
        ("server.pem", "missing.key", None),
        ("server.key", "server.key", None),
        ("server.pem", "server.key", "server.key"),
    ],
)
def test_bad_pem_files_are_named_before_anything_is_served(pem, cert, key, ca):
    tls = Tls(pem / cert, pem / key, pem / ca if ca else None)
    with pytest.raises(ServerError, match=f"TLS cannot be set up from .*{key}"):
        SensorServer(SceneStore(), port=0, server_options=ServerOptions(tls=tls)).start()


def test_a_client_says_what_its_tls_lacks(pem, tmp_path):
    with pytest.raises(ServerError, match="needs root_ca, client_cert and client_key together"):
        RemoteSensors("localhost:1", client_cert=pem / "client.pem", client_key=pem / "client.key")
    with pytest.raises(ServerError, match="no-such.pem"):
        RemoteSensors("localhost:1", root_ca=tmp_path / "no-such.pem")


def test_a_token_opens_all_and_health_needs_none():
    with street_server(token=TOKEN) as address:
        with RemoteSensors(address, "street", timeout_s=20, token=TOKEN) as remote:
            assert remote.scenes() == ["clipgt-street"]
            assert remote.sense([camera_request("fish")])[0].rgb.any()
        for wrong in (None, TOKEN[:-1], TOKEN + "x", "Bearer"):
            with RemoteSensors(address, timeout_s=20, token=wrong) as remote:
                with pytest.raises(ServerError, match="UNAUTHENTICATED: this server wants 'authorization: Bearer"):
                    remote.version()
        with Stub(address) as stub:
            assert refusal(stub.render_rgb, camera_message())[0] == Code.UNAUTHENTICATED
            assert health_of(stub.channel) == health_pb2.HealthCheckResponse.SERVING
            metadata = [("authorization", f"bearer {TOKEN}")]  # the scheme's case does not matter (RFC 9110 11.1)
            assert stub.get_version(common.Empty(), metadata=metadata, timeout=10).version_id


def test_only_the_whole_token_is_it():
    assert shows_token({"authorization": f"Bearer {TOKEN}"}, TOKEN)
    for given in ({}, {"authorization": TOKEN}, {"authorization": "Basic " + TOKEN}, {"authorization": "Bearer "}):
        assert not shows_token(given, TOKEN)
    assert not shows_token({"authorization": b"Bearer " + TOKEN.encode()}, TOKEN)


def test_a_token_comes_from_a_file_or_the_environment(tmp_path, monkeypatch):
    monkeypatch.delenv("NUREC_SIM_TOKEN", raising=False)
    assert read_token(None) is None
    monkeypatch.setenv("NUREC_SIM_TOKEN", "from-the-environment")
    assert read_token(None) == "from-the-environment"
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    assert read_token(file) == TOKEN
    for bad in ("", "short", "two words inside", "t\u00f6ken-with-umlaut"):
        file.write_text(bad, "utf-8")
        with pytest.raises(ServerError, match="token"):
            read_token(file)
    with pytest.raises(ServerError, match="cannot be read from .*missing"):
        read_token(tmp_path / "missing")


def test_no_secret_shows_in_the_options():
    assert TOKEN not in repr(ServerOptions(token=TOKEN))


@pytest.mark.parametrize(
    ("host", "inside"),
    [
        ("127.0.0.1", True), ("127.8.9.1", True), ("localhost", True), ("::1", True), ("[::1]", True),
        ("0.0.0.0", False), ("::", False), ("192.168.0.7", False), ("example.com", False), ("", False),
    ],
)  # fmt: skip
def test_other_machines_are_let_in_only_on_purpose(host, inside):
    assert is_loopback(host) == inside
    check_exposure(host, protected=True, insecure=False)
    check_exposure(host, protected=False, insecure=True)
    if inside:
        check_exposure(host, protected=False, insecure=False)
    else:
        with pytest.raises(ServerError, match="refused to listen .*--insecure"):
            check_exposure(host, protected=False, insecure=False)


def test_the_loopback_of_version_6_can_be_served():
    try:
        with SensorServer(SceneStore([scene()]), "::1", 0) as address, grpc.insecure_channel(address) as channel:
            assert health_of(channel) == health_pb2.HealthCheckResponse.SERVING
    except OSError as error:
        pytest.skip(f"this machine has no IPv6: {error}")
