"""Finding and fetching weights, with a hub that is a folder; nothing here uses a network."""

import hashlib
import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from network_weights import KEYS, base_state, part

from nurec_sim import cli, network
from nurec_sim.cli import weights as verbs
from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints import download, released
from nurec_sim.network.checkpoints import fit as weights_check
from nurec_sim.network.checkpoints import state_dicts as checkpoints
from nurec_sim.network.checkpoints.download import CHECKPOINT_VARIABLE, fetch, find_weights, verify_file
from nurec_sim.network.checkpoints.released import RELEASED, ReleasedFile
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.network.model import InstantNuRec

CONTENT = b"not really weights"


@dataclass
class FakeHub:
    """What is used of huggingface_hub: files of a folder, copied into a cache with links like the real one."""

    cache: Path
    published: dict[str, bytes]
    asked: list[tuple[str, str, str]] = field(default_factory=list)

    def hf_hub_download(self, repository: str, filename: str, *, revision: str, local_dir: Path | None) -> str:
        self.asked.append((repository, filename, revision))
        if filename not in self.published:
            raise FileNotFoundError("An error happened while trying to locate the file.\nDetails follow.")
        if local_dir is not None:
            target = Path(local_dir) / filename
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(self.published[filename])
            return str(target)
        blob = self.cache / "blobs" / filename.replace("/", "_")
        link = self.cache / "snapshots" / revision / filename
        for folder in (blob.parent, link.parent):
            folder.mkdir(parents=True, exist_ok=True)
        blob.write_bytes(self.published[filename])
        link.unlink(missing_ok=True)
        link.symlink_to(blob)
        return str(link)

    def try_to_load_from_cache(self, repository: str, filename: str, *, revision: str) -> str | None:
        path = self.cache / "snapshots" / revision / filename
        return str(path) if path.is_file() else None


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    """pa-front is ``CONTENT`` with a known digest."""
    monkeypatch.delenv(CHECKPOINT_VARIABLE, raising=False)
    small = replace(RELEASED["pa-front"], size_bytes=len(CONTENT), sha256=hashlib.sha256(CONTENT).hexdigest())
    monkeypatch.setattr(download, "RELEASED", {**RELEASED, "pa-front": small})
    monkeypatch.setattr(released, "RELEASED", {**RELEASED, "pa-front": small})
    fake = FakeHub(tmp_path / "cache", {small.filename: CONTENT})
    monkeypatch.setattr(download, "hub_library", lambda: fake)
    return fake


def file_of(profile: str) -> ReleasedFile:
    return download.RELEASED[profile]


# --- the table


def test_the_table_says_what_is_published() -> None:
    multiview = RELEASED["pa-multiview"]
    assert (multiview.repository, multiview.filename) == (
        "nvidia/instant-nurec",
        "pth/instant_nurec_pa_multiview_1.1.0.pth",
    )
    assert multiview.size_bytes == 730_202_407 and multiview.size_is_published
    assert multiview.sha256 is not None and multiview.sha256.startswith("946e2f66aca98ce8")
    for file in RELEASED.values():
        assert file.sha256 is None or re.fullmatch("[0-9a-f]{64}", file.sha256)
        assert file.size_is_published == (file.sha256 is not None)


@pytest.mark.parametrize(
    ("profile", "keys"), [("pa-front", "pa_front"), ("pa-multiview", "pa_multiview"), ("pq-front", "pq_road")]
)
def test_sizes_are_those_of_the_values_and_a_list_of_names(profile: str, keys: str) -> None:
    shapes = [fact["shape"] for fact in json.loads((KEYS / f"{keys}.json").read_text()).values()]
    values = sum(4 * torch.Size(shape).numel() for shape in shapes)
    assert 0 < RELEASED[profile].size_bytes - values < 500 * len(shapes)


def test_the_verbs_know_every_profile_and_every_file() -> None:
    assert set(get_args(verbs.Fetchable)) == set(RELEASED)
    assert set(get_args(verbs.Checkable)) == {*network.PROFILES, *LIDAR_PROFILES}


# --- finding


def test_what_is_given_comes_first_then_the_environment_then_ours_then_the_cache(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached = fetch(file_of("pa-front"))
    assert find_weights("pa-front") == cached
    monkeypatch.setattr(download, "_SHIPPED", tmp_path)
    ours = tmp_path / "pa-front.safetensors"
    ours.write_bytes(b"")
    assert find_weights("pa-front") == ours
    named = tmp_path / "any name"
    named.write_bytes(b"")
    monkeypatch.setenv(CHECKPOINT_VARIABLE, str(named))
    for profile in (*network.PROFILES, *LIDAR_PROFILES):
        assert find_weights(profile) == named
    given = tmp_path / "given.pth"
    given.write_bytes(b"")
    assert find_weights("pa-front", given) == given
    assert len(hub.asked) == 1


def test_what_is_not_there_is_said_with_what_to_do(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "_SHIPPED", tmp_path)
    for profile, text in (
        ("pa-front", "weights fetch pa-front` gets them .*--checkpoint PATH"),
        ("tiny", "weights of 'tiny' are not part of this version.*--checkpoint PATH, or --random-weights SEED"),
        ("pa-full", "none are published"),
        ("huge", "no network profile 'huge'; have .*'tiny'"),
    ):
        with pytest.raises(WeightsError, match=text):
            find_weights(profile)
    with pytest.raises(WeightsError, match="no weights at .*nowhere.pth"):
        find_weights("pa-front", tmp_path / "nowhere.pth")
    monkeypatch.setenv(CHECKPOINT_VARIABLE, str(tmp_path / "gone.pth"))
    with pytest.raises(WeightsError, match="INSTANT_NUREC_FULL_PT names .*gone.pth', which is no file"):
        find_weights("pa-front")
    assert not hub.asked


def test_a_cached_file_of_the_wrong_size_is_not_used(hub: FakeHub) -> None:
    fetch(file_of("pa-front")).write_bytes(CONTENT + b"!")
    with pytest.raises(WeightsError, match="has 19 bytes, the released file of 'pa-front' 18"):
        find_weights("pa-front")


# --- fetching


def test_fetching_asks_for_the_file_at_a_revision(hub: FakeHub, tmp_path: Path) -> None:
    pa_front = file_of("pa-front")
    assert fetch(pa_front).read_bytes() == CONTENT
    assert fetch(pa_front, "850f6b5", tmp_path / "here") == tmp_path / "here" / pa_front.filename
    assert hub.asked == [(pa_front.repository, pa_front.filename, revision) for revision in ("main", "850f6b5")]


def test_a_file_with_another_digest_is_removed_with_what_it_links_to(hub: FakeHub) -> None:
    hub.published[file_of("pa-front").filename] = CONTENT[::-1]
    with pytest.raises(WeightsError, match="has SHA-256 [0-9a-f]{64}, the released file of 'pa-front' [0-9a-f]{64}"):
        fetch(file_of("pa-front"))
    assert not [path for path in hub.cache.rglob("*") if path.is_file() or path.is_symlink()]
    with pytest.raises(WeightsError, match="not on this machine"):
        find_weights("pa-front")


def test_a_file_of_another_size_is_refused_and_kept_for_those_who_trust_it(hub: FakeHub) -> None:
    hub.published[file_of("pa-front").filename] = CONTENT * 2
    with pytest.raises(WeightsError, match="has 36 bytes.*if you trust it, give it with --checkpoint") as caught:
        fetch(file_of("pa-front"))
    kept = Path(str(caught.value).split(" has ")[0])
    assert find_weights("pa-front", kept) == kept


def test_what_the_hub_cannot_give_is_one_line(hub: FakeHub) -> None:
    with pytest.raises(WeightsError) as caught:
        fetch(file_of("pq-front"))
    assert "cannot get pth/instant_nurec_pq_road_1.0.0.pth from nvidia/instant-nurec: An error" in str(caught.value)
    assert "--checkpoint PATH" in str(caught.value) and "\n" not in str(caught.value)


def test_without_the_library_the_text_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CHECKPOINT_VARIABLE, raising=False)

    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(download.importlib, "import_module", absent)
    with pytest.raises(WeightsError, match=r"pip install 'nurec-sim\[hub\]'.*--checkpoint PATH"):
        fetch(RELEASED["pa-front"])
    assert download.cached_file(RELEASED["pa-front"]) is None
    with pytest.raises(WeightsError, match="not on this machine"):
        find_weights("pa-front")


def test_the_real_library_takes_these_arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against huggingface_hub itself, told to stay offline, with an empty cache and then with one as it writes it."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    pa_front = replace(RELEASED["pa-front"], size_bytes=len(CONTENT), sha256=None)
    assert download.cached_file(pa_front) is None
    with pytest.raises(WeightsError, match="cannot get .*Without a network"):
        fetch(pa_front)
    repository = tmp_path / "models--nvidia--instant-nurec"
    commit = "0123456789" * 4
    path = repository / "snapshots" / commit / pa_front.filename
    path.parent.mkdir(parents=True)
    path.write_bytes(CONTENT)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    assert download.cached_file(pa_front) == path
    assert fetch(pa_front) == path


def test_a_file_is_checked_by_size_before_anything_is_read(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    path.write_bytes(CONTENT)
    with pytest.raises(WeightsError, match="730,202,407"):
        verify_file(path, RELEASED["pa-multiview"])
    verify_file(path, replace(RELEASED["pa-multiview"], size_bytes=len(CONTENT)), digest=False)
    with pytest.raises(WeightsError, match="SHA-256"):
        verify_file(path, replace(RELEASED["pa-multiview"], size_bytes=len(CONTENT)))


# --- the verbs


@pytest.fixture(scope="module")
def tiny() -> InstantNuRec:
    return network.build("tiny")


def run(*arguments: str) -> int:
    try:
        cli.main(["weights", *arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_list_shows_what_is_here(hub: FakeHub, capsys: pytest.CaptureFixture[str]) -> None:
    fetch(file_of("pa-front"))
    assert run("list") == 0
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines() if line.startswith("│")}
    assert set(lines) == {*network.PROFILES, *LIDAR_PROFILES, "da3-base"}
    assert "fetched" in lines["pa-front"] and "182.5 M" in lines["pa-front"]
    assert "missing" in lines["pq-front"] and "1,141,125,047" in lines["pq-front"]
    assert "946e2f66aca9" in lines["pa-multiview"]
    assert "not published" in lines["pa-full"]


def test_fetch_says_what_it_gets_and_where_it_is(
    hub: FakeHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("fetch", "pa-front", "--revision", "abc", "--to", str(tmp_path / "to")) == 0
    text = capsys.readouterr().out
    assert "NVIDIA Open Model License" in text and "size and SHA-256 are right" in text
    assert f"--checkpoint {tmp_path / 'to' / 'pth'}" in text
    hub.published.clear()
    assert run("fetch", "pa-front") == 1
    assert "cannot get" in capsys.readouterr().err


def test_check_knows_our_own_weights(tiny: InstantNuRec, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tiny.safetensors"
    checkpoints.save_weights(tiny, path, {"trained on": "towns\x1b[2J"}, half=True)
    assert run("check", str(path), "--profile", "tiny") == 0
    text = capsys.readouterr().out
    assert re.search(r"fits +│ tiny ", text) and "float16 x" in text and "towns?[2J" in text and "no faults" in text
    assert run("check", str(path), "--profile", "tiny-selective") == 1
    assert "fault: does not fit 'tiny-selective'" in capsys.readouterr().out


def test_check_lists_faults(tiny: InstantNuRec, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = tiny.state_dict()
    state["sky.extra"] = torch.tensor([float("nan")])
    torch.save(state, tmp_path / "instant_nurec_pa_front_1.1.0.pth")
    assert run("check", str(tmp_path / "instant_nurec_pa_front_1.1.0.pth")) == 1
    text = capsys.readouterr().out
    assert "fault: sky.extra holds values that are not finite" in text
    assert "fault: fits no profile; nearest is 'tiny': 1 unexpected: sky.extra" in text
    assert "fault: is named like the released file of 'pa-front', which has 730,200,087 bytes" in text
    torch.save({"conv.weight": torch.ones(1)}, tmp_path / "w.pth")
    assert run("check", str(tmp_path / "w.pth")) == 1
    assert "is not of this network: none of its 1 names is, such as 'conv.weight'" in capsys.readouterr().out
    assert run("check", str(tmp_path / "nowhere.pth")) == 1
    assert "no weights at" in capsys.readouterr().err


def test_check_knows_released_files_by_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "w.pth"
    torch.save(part().state_dict(), path)
    known = replace(RELEASED["pa-multiview"], size_bytes=path.stat().st_size, sha256=download.sha256(path))
    monkeypatch.setattr(weights_check, "RELEASED", {"pa-multiview": known})
    assert run("check", str(path)) == 1  # for its names are none of the network's
    assert "the file of 'pa-multiview', by size and SHA-256" in capsys.readouterr().out
    monkeypatch.setattr(weights_check, "RELEASED", {"pa-multiview": replace(known, sha256="0" * 64)})
    assert run("check", str(path)) == 1
    assert "as long as that of 'pa-multiview'" in capsys.readouterr().out


def test_released_names_fit_their_profiles_and_no_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "w.pth").write_bytes(b"")
    monkeypatch.setattr(weights_check, "non_finite", lambda state: [])
    for keys, profiles in (
        ("pa_front", "pa-front, pa-multiview"),
        ("pq_road", "pq-front"),
        ("full_model_with_sky", "pa-full"),
    ):
        facts = json.loads((KEYS / f"{keys}.json").read_text())
        state = {name: torch.zeros(()).expand(fact["shape"]) for name, fact in facts.items()}
        monkeypatch.setattr(weights_check, "load_state_dict", lambda path, state=state: state)
        report = weights_check.check_weights(tmp_path / "w.pth")
        assert dict(report.facts)["fits"] == profiles
        assert not report.faults
    monkeypatch.setattr(weights_check, "load_state_dict", lambda path: base_state())
    report = weights_check.check_weights(tmp_path / "w.pth")
    assert dict(report.facts)["fits"] == "da3-base" and not report.faults
