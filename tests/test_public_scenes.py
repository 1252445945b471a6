"""Public scenes by name: what is listed, and getting them from a server on this machine, a folder, an archive."""

import hashlib
import http.server
import io
import re
import stat
import tarfile
import threading
import zipfile
from pathlib import Path

import mitsuba as mi
import pytest
from typer.testing import CliRunner

from mi_neural import cli, scenes
from mi_neural.bench import checksums, fetch, load
from mi_neural.bench.load import InputError
from mi_neural.scenes import public

XML = """<scene version="3.0.0"> <default name="spp" value="1"/> <integrator type="path"/>
<sensor type="perspective"> <film type="hdrfilm"> <integer name="width" value="4"/> <integer name="height" value="4"/>
</film> <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler> </sensor>
<emitter type="constant"/> </scene>"""


def zipped(files: dict[str, str | bytes]) -> bytes:
    """An archive whose bytes are the same each time."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, text in files.items():
            archive.writestr(zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0)), text)
    return out.getvalue()


#: Large enough to come in several blocks.
ARCHIVE = zipped({"veach-ajar/scene_v3.xml": XML, "veach-ajar/textures/a.bin": bytes(range(256)) * 8192})
SHA256 = hashlib.sha256(ARCHIVE).hexdigest()


class Server(http.server.ThreadingHTTPServer):
    """Serves `data` as every file. `stop_at`: bytes after which it hangs up; `ranges`: whether it can go on."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.data, self.tag, self.stop_at, self.ranges, self.asked, self.status = ARCHIVE, '"1"', None, True, [], 200

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/mirror"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server, start = self.server, 0
        wanted = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        server.asked.append((self.path, int(wanted[1]) if wanted else 0))
        if server.status != 200:
            return self.send_error(server.status)
        if wanted and server.ranges and self.headers.get("If-Range") == server.tag:
            start = int(wanted[1])
        if start >= len(server.data):
            return self.send_error(416)
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(server.data) - 1}/{len(server.data)}")
        self.send_header("Content-Length", str(len(server.data) - start))
        self.send_header("ETag", server.tag)
        self.end_headers()
        self.wfile.write(server.data[start : server.stop_at])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    with Server() as found:
        threading.Thread(target=found.serve_forever, args=(0.01,), daemon=True).start()
        yield found
        found.shutdown()


@pytest.fixture
def store(tmp_path, monkeypatch):
    """The folder of the scenes, empty."""
    folder = tmp_path / "store"
    monkeypatch.setenv("MI_NEURAL_SCENES", str(folder))
    return folder


def left(store: Path) -> list[str]:
    """What lies in the store beside scenes and the list of checksums, at any depth."""
    found = [f.relative_to(store) for f in store.rglob("*") if f.is_file()]
    return sorted(str(f) for f in found if f.parts[0] not in (*public.SCENES, "checksums.json"))


def run(*words: str):
    return CliRunner().invoke(cli.app, list(words))


# ---------------------------------------------------------------- getting


def test_scene_from_a_server_is_whole_and_every_command_takes_its_name(server, store):
    done = run("scenes", "get", "veach-ajar", "--from", server.url)
    assert done.exit_code == 0, done.output
    assert f"SHA-256 {SHA256}: no checksum was known before" in done.stdout
    assert server.asked == [("/mirror/veach-ajar.zip", 0)] and left(store) == []
    assert (store / "veach-ajar/textures/a.bin").stat().st_size == 2**21
    assert load.find_scene("veach-ajar") == (store / "veach-ajar/scene.xml").resolve() == scenes.path("veach-ajar")
    loaded = load.load_scene("veach-ajar")
    assert loaded.name == "veach-ajar" and mi.render(loaded.scene).shape == (4, 4, 3)
    assert run("plan", "veach-ajar").exit_code == 0
    again = run("scenes", "get", "veach-ajar", "--from", server.url)
    assert "veach-ajar is in" in again.stdout and len(server.asked) == 1, "what is there is not got again"


def test_own_address_is_the_default(server, store, monkeypatch):
    scene = public.Public("A", "B", "CC0", f"{server.url}/other.zip")
    monkeypatch.setitem(public.SCENES, "veach-ajar", scene)
    assert fetch.get("veach-ajar").new and server.asked == [("/mirror/other.zip", 0)]


@pytest.mark.parametrize("ranges", [True, False])
def test_what_was_interrupted_is_gone_on_with_or_begun_anew(server, store, ranges):
    server.stop_at, server.ranges = 700_000, ranges
    with pytest.raises(InputError, match=r"0\.7 MB are kept, the same command goes on from there"):
        fetch.get("veach-ajar", server.url)
    assert not (store / "veach-ajar").exists()
    server.stop_at, seen = None, []
    found = fetch.get("veach-ajar", server.url, lambda done, total: seen.append((done, total)))
    assert server.asked[1][1] == 700_000 and found.sha256 == SHA256 and left(store) == []
    assert (seen[0][0] > 700_000) == ranges and seen[-1] == (len(ARCHIVE), len(ARCHIVE))


def test_a_file_that_changed_in_between_is_begun_anew(server, store):
    server.stop_at = 700_000
    with pytest.raises(InputError):
        fetch.get("veach-ajar", server.url)
    server.stop_at, server.tag = None, '"2"'
    server.data = zipped({"scene.xml": XML, "b.bin": bytes(1 << 20)})
    assert fetch.get("veach-ajar", server.url).sha256 == hashlib.sha256(server.data).hexdigest()
    assert (store / "veach-ajar/b.bin").is_file() and not (store / "veach-ajar/textures").exists()


def test_a_file_that_became_shorter_is_begun_anew(server, store):
    server.stop_at = 700_000
    with pytest.raises(InputError):
        fetch.get("veach-ajar", server.url)
    server.stop_at, server.data = None, zipped({"scene.xml": XML})
    assert fetch.get("veach-ajar", server.url).folder.is_dir() and left(store) == []


def test_ctrl_c_keeps_what_came(server, store):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"0\.3 MB are kept"):
        fetch.get("veach-ajar", server.url, stop)
    assert not (store / "veach-ajar").exists()
    assert fetch.get("veach-ajar", server.url).sha256 == SHA256
    assert server.asked[1][1] == fetch.BLOCK


def test_folder_archive_and_mirror_without_the_archives_name(server, store, tmp_path):
    mirror = tmp_path / "mirror"
    for part in ("a", "b"):
        (mirror / part).mkdir(parents=True)
    (mirror / "a/veach-ajar.zip").write_bytes(ARCHIVE)
    (mirror / "b/sponza-gray").mkdir()
    for file in public.SCENES["sponza-gray"].files:
        (mirror / f"b/sponza-gray/{file}.xml").write_text(XML)
    assert fetch.get("veach-ajar", str(mirror / "a")).sha256 == SHA256
    assert fetch.get("sponza-gray", str(mirror / "b")).sha256 is None
    assert load.find_scene("sponza-gray/sun") == (store / "sponza-gray/sun.xml").resolve()
    assert (mirror / "a/veach-ajar.zip").is_file() and (mirror / "b/sponza-gray/sun.xml").is_file()
    with pytest.raises(InputError, match=r"neither a folder staircase2 with scene\.xml nor an archive staircase2\.zip"):
        fetch.get("staircase2", str(mirror))
    with pytest.raises(InputError, match="there is no such folder or archive"):
        fetch.get("staircase2", str(mirror / "c"))


def test_tar_archives_are_taken(store, tmp_path):
    archive = tmp_path / "x.tar.gz"
    with tarfile.open(archive, "w:gz") as out:
        info = tarfile.TarInfo("deep/down/scene.xml")
        info.size = len(XML)
        out.addfile(info, io.BytesIO(XML.encode()))
    fetch.get("staircase2", str(archive))
    assert [f.name for f in sorted((store / "staircase2").iterdir())] == [".mi_neural.json", "scene.xml"]


# ---------------------------------------------------------------- checksums


def test_known_checksum_must_be_met(server, store, monkeypatch):
    right = public.Public("A", "B", "CC0", server.url, sha256=SHA256)
    wrong = public.Public("A", "B", "CC0", server.url, sha256="0" * 64)
    monkeypatch.setitem(public.SCENES, "veach-ajar", wrong)
    with pytest.raises(InputError, match=f"not the one that is known: its SHA-256 is {SHA256}, it should be 0000"):
        fetch.get("veach-ajar", f"{server.url}/a.zip", accept=True)
    assert left(store) == [] and not (store / "veach-ajar").exists()
    monkeypatch.setitem(public.SCENES, "veach-ajar", right)
    assert not fetch.get("veach-ajar", f"{server.url}/a.zip").new


def test_later_archive_is_compared_with_the_first(server, store):
    fetch.get("veach-ajar", server.url)
    (store / "veach-ajar").rename(store / "moved")
    server.data = zipped({"scene.xml": XML})
    done = run("scenes", "get", "veach-ajar", "--from", server.url)
    assert done.exit_code == 2 and "has changed" in done.output and SHA256 in done.output
    assert not (store / "veach-ajar").exists()
    assert run("scenes", "get", "veach-ajar", "--from", server.url, "--accept").exit_code == 0
    assert checksums.remembered("veach-ajar")["sha256"] == hashlib.sha256(server.data).hexdigest() != SHA256


# ---------------------------------------------------------------- checksums of files


@pytest.fixture
def known(monkeypatch):
    """Known files of veach-ajar: those of `ARCHIVE`'s texture, of another file that it lacks, and of a conversion."""
    facts = lambda data: [len(data), hashlib.sha256(data).hexdigest()]  # noqa: E731
    lists = {"copies": ["a/b", "c/d"], "published": {"textures/a.bin": facts(bytes(range(256)) * 8192),
                                                   "models/b.obj": facts(b"v 0 0 0")},
             "measured": {"scene.xml": facts(XML.encode()), "meshes/c.ply": facts(b"ply")}}  # fmt: skip
    monkeypatch.setattr(checksums, "_lists", lambda: {"veach-ajar": lists})


def test_files_of_an_archive_are_compared_with_known_ones(server, store, known):
    done = run("scenes", "get", "veach-ajar", "--from", server.url)
    assert "1 of 2 known files are there, byte for byte as those of public copies of the archive" in done.stdout
    assert "not known: scene.xml" in done.stdout
    assert "checksums of 2 of its files (2.1 MB) and 2 of the files of our conversion" in run("scenes").stdout


def test_archive_with_another_file_of_a_known_name_is_refused(server, store, known):
    server.data = zipped({"scene_v3.xml": XML, "textures/a.bin": b"another"})
    done = run("scenes", "get", "veach-ajar", "--from", server.url)
    assert done.exit_code == 2 and "files of veach-ajar are not those of public copies" in done.output
    assert "textures/a.bin" in done.output and not (store / "veach-ajar").exists() and left(store) == []
    assert checksums.remembered("veach-ajar") is None, "what was refused is no measure of later ones"
    taken = run("scenes", "get", "veach-ajar", "--from", server.url, "--accept")
    assert taken.exit_code == 0 and "different: textures/a.bin" in taken.stdout
    check = run("scenes", "check")
    assert check.exit_code == 2 and "files of veach-ajar are not the known ones" in check.output


def test_converted_scene_is_known_as_what_was_measured(store, known, tmp_path):
    folder = tmp_path / "mirror/veach-ajar"
    (folder / "meshes").mkdir(parents=True)
    (folder / "scene.xml").write_text(XML)
    (folder / "meshes/c.ply").write_bytes(b"ply")
    (folder / "reference_4x4.exr").write_bytes(b"")
    done = run("scenes", "get", "veach-ajar", "--from", str(tmp_path / "mirror"))
    assert "2 of 2 known files are there, byte for byte as those that the tables were measured on" in done.stdout
    assert run("scenes", "check").exit_code == 0 == run("scenes", "check", "veach-ajar").exit_code
    (store / "veach-ajar/meshes/c.ply").write_bytes(b"plx")
    assert checksums.compare("veach-ajar", store / "veach-ajar").differing == ["meshes/c.ply"]


def test_scene_that_is_not_here_cannot_be_checked(store):
    assert run("scenes", "check").exit_code == 0
    done = run("scenes", "check", "veach-ajar")
    assert done.exit_code == 2 and "type mi-neural scenes get veach-ajar" in done.output


def test_known_files_of_every_scene_of_the_tables():
    for name, scene in public.SCENES.items():
        measured, published = checksums.files(name, "measured"), checksums.files(name, "published")
        assert {f"{file}.xml" for file in scene.files} <= set(measured)
        assert bool(published) == bool(scene.url) and (len(checksums.copies(name)) > 1) == bool(scene.url)
        for path, (size, sha256) in (measured | published).items():
            assert size > 0 and re.fullmatch("[0-9a-f]{64}", sha256) and not path.startswith(("/", ".")), path


@pytest.mark.parametrize("name", public.SCENES)
def test_scene_on_this_machine_has_known_files(name):
    folder = public.folder() / name
    if not folder.is_dir():
        pytest.skip(f"needs a public scene; type mi-neural scenes get {name}")
    found = checksums.compare(name, folder)
    assert found.same and not found.differing, found.text


# ---------------------------------------------------------------- archives that are refused


def link() -> zipfile.ZipInfo:
    found = zipfile.ZipInfo("link.xml")
    found.external_attr = (stat.S_IFLNK | 0o777) << 16
    return found


@pytest.mark.parametrize("name", ["../outside.xml", "/tmp/outside.xml", "a/../../outside.xml", "..\\outside.xml",
                                  "C:\\outside.xml", link()])  # fmt: skip
def test_archive_that_reaches_outside_is_refused(server, store, name):
    server.data = zipped({"scene.xml": XML})
    out = io.BytesIO(server.data)
    with zipfile.ZipFile(out, "a") as archive:
        archive.writestr(name, "../../etc")
    server.data = out.getvalue()
    with pytest.raises(InputError, match="a link or lies outside of its folder: refused"):
        fetch.get("veach-ajar", server.url)
    assert left(store) == [] and not (store / "veach-ajar").exists()
    assert not list(store.parent.rglob("outside*"))


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE])
def test_tar_with_links_or_devices_is_refused(store, tmp_path, kind):
    archive = tmp_path / "x.tar"
    with tarfile.open(archive, "w") as out:
        info = tarfile.TarInfo("scene.xml")
        info.type, info.linkname = kind, "/etc/passwd"
        out.addfile(info)
    with pytest.raises(InputError, match="refused"):
        fetch.get("veach-ajar", str(archive))
    assert not (store / "veach-ajar").exists()


@pytest.mark.parametrize("data, says", [
    (b"<html>gone</html>", "no zip or tar archive"),
    (zipped({"readme.txt": "x"}), r"holds no scene_v3\.xml or scene\.xml"),
    (ARCHIVE[:1000] + ARCHIVE[1100:], "damaged"),
])  # fmt: skip
def test_what_is_no_archive_of_a_scene_is_refused_and_not_kept(server, store, data, says):
    server.data = data
    with pytest.raises(InputError, match=says):
        fetch.get("veach-ajar", server.url)
    assert left(store) == [] and not (store / "veach-ajar").exists()


def test_archive_that_would_fill_the_disk_is_refused(server, store, monkeypatch):
    monkeypatch.setattr(fetch, "MOST_BYTES", 1 << 20)
    with pytest.raises(InputError, match="would unpack to"):
        fetch.get("veach-ajar", server.url)
    assert left(store) == [] and not (store / "veach-ajar").exists()


# ---------------------------------------------------------------- what is said


@pytest.mark.parametrize("words, says", [
    (("scenes", "get", "veach-ajr"), "no public scene 'veach-ajr', did you mean 'veach-ajar'\\?; there are: "),
    (("scenes", "get", "ajar_door"), "shipped with the package: there is nothing to get"),
    (("scenes", "get", "sponza-gray"), "no public archive .*give --from FOLDER or URL"),
    (("render", "staircase2"), "not on this machine: type mi-neural scenes get staircase2"),
    (("render", "sponza-gray"), "several scene files: .*sponza-gray/sun"),
    (("render", "sponza-gray/sunn"), "did you mean 'sponza-gray/sun'"),
    (("compare", "staircase", "-o", "x"), "did you mean 'staircase2'"),
])  # fmt: skip
def test_names_that_are_not_there_are_refused_in_one_line(store, words, says):
    done = run(*words)
    assert done.exit_code == 2 and re.search(says, done.output.replace("\n", " ")), done.output
    assert len([line for line in done.output.splitlines() if not line.startswith("getting ")]) == 1


def test_server_that_refuses_and_server_that_is_not_there(server, store):
    server.status = 404
    with pytest.raises(InputError, match=r"the server says 404 .*; give --from FOLDER or URL"):
        fetch.get("veach-ajar", server.url)
    with pytest.raises(InputError, match=r"nothing came\. Or give --from FOLDER or URL"):
        fetch.get("veach-ajar", "http://127.0.0.1:9/")
    assert left(store) == []


def test_folder_without_its_scene_file_is_named(store):
    (store / "veach-ajar").mkdir(parents=True)
    with pytest.raises(InputError, match="lacks a scene file of scene: remove it"):
        fetch.get("veach-ajar", "http://127.0.0.1:9/")


def test_list_says_what_is_here_and_what_is_known(server, store):
    before = run("scenes").stdout
    assert all(name in before for name in (*scenes.names(), *public.names(), *public.SCENES))
    assert "veach-ajar: not here; type mi-neural scenes get veach-ajar" in before
    fetch.get("veach-ajar", server.url)
    after = run("scenes").stdout
    assert "veach-ajar: here" in after and f"SHA-256 {SHA256} found" in after
    assert re.search(r"sponza-gray/sun: not here; type mi-neural scenes get sponza-gray --from", after)


def test_folder_of_the_scenes_is_the_users_cache_by_default(monkeypatch, tmp_path):
    monkeypatch.delenv("MI_NEURAL_SCENES", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert public.folder() == tmp_path / "mi_neural/scenes"
    with pytest.raises(ValueError, match="type mi-neural scenes get veach-ajar"):
        scenes.path("veach-ajar")


def test_catalogue_is_complete():
    for name, scene in public.SCENES.items():
        assert scene.title and scene.author and scene.licence and (scene.url or scene.note), name
        assert scene.sha256 is None or re.fullmatch("[0-9a-f]{64}", scene.sha256)
        assert name not in scenes.names()
