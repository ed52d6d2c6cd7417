"""Assets from archives made here; nothing is fetched from anywhere."""

import io
import tarfile
import zipfile

import pytest

from pipeline.config import assets
from pipeline.config.workspace import REPOSITORY, open_workspace
from pipeline.errors import UserError
from pipeline.store import digest


@pytest.fixture
def workspace(tmp_path):
    (tmp_path / "data").mkdir()
    return open_workspace(data=tmp_path / "data")


def make_wheel(path, members):
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as wheel:
        for name, content in members.items():
            wheel.writestr(name, content)


def declare(
    workspace, archive, members=("pkg/data/*",), root="pkg/data", sha256=None, package="no-such-package==1"
):
    sha256 = sha256 or digest.of_file(archive)
    listed = ", ".join(f'"{member}"' for member in members)
    (workspace.data / "assets.toml").write_text(
        f'[thing]\ntitle = "a thing"\nlicence = "CC0"\npackage = "{package}"\nroot = "{root}"\n'
        f'members = [{listed}]\narchives = [{{ name = "{archive.name}", sha256 = "{sha256}" }}]\n'
    )
    return assets.find_asset(workspace, "thing")


def test_a_given_archive_is_checked_unpacked_and_then_needed_no_more(workspace):
    archive = workspace.assets / "archives" / "no_such_package-1-py3-none-any.whl"
    make_wheel(archive, {"pkg/data/a.txt": "a", "pkg/data/deep/b.txt": "b", "pkg/code.py": "boom"})
    asset = declare(workspace, archive)
    assert not assets.is_ready(workspace, asset)
    with pytest.raises(UserError, match="doit run assets:thing"):
        assets.require(workspace, "thing")
    folder = assets.fetch(workspace, asset)
    assert sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*.*")) == [
        "a.txt",
        "asset.json",
        "deep/b.txt",
    ]
    archive.unlink()  # offline from here on: the warm cache is enough
    assert assets.fetch(workspace, asset) == folder == assets.require(workspace, "thing")
    (folder / "a.txt").unlink()
    assert not assets.is_ready(workspace, asset)


def test_source_archives_are_unpacked_too(workspace):
    archive = workspace.assets / "archives" / "thing-1.tar.gz"
    archive.parent.mkdir(parents=True)
    with tarfile.open(archive, "w:gz") as tar:
        info = tarfile.TarInfo("pkg/data/a.bin")
        info.size = 3
        tar.addfile(info, io.BytesIO(b"abc"))
    folder = assets.fetch(workspace, declare(workspace, archive))
    assert (folder / "a.bin").read_bytes() == b"abc"


def test_a_wrong_hash_is_refused_and_nothing_is_left(workspace):
    archive = workspace.assets / "archives" / "thing-1-py3-none-any.whl"
    make_wheel(archive, {"pkg/data/a.txt": "a"})
    asset = declare(workspace, archive, sha256="0" * 64)
    with pytest.raises(UserError, match="SHA-256"):
        assets.fetch(workspace, asset)
    assert not (workspace.assets / "thing").exists()


def test_an_archive_cannot_write_outside_its_folder(workspace):
    archive = workspace.assets / "archives" / "thing-1-py3-none-any.whl"
    make_wheel(archive, {"pkg/data/../../../../evil.txt": "evil"})
    with pytest.raises(UserError, match="outside its folder"):
        assets.fetch(workspace, declare(workspace, archive))
    assert not list(workspace.data.parent.rglob("evil.txt"))


def test_a_damaged_archive_names_itself(workspace):
    archive = workspace.assets / "archives" / "thing-1-py3-none-any.whl"
    archive.parent.mkdir(parents=True)
    archive.write_bytes(b"not a zip")
    with pytest.raises(UserError, match="is damaged"):
        assets.fetch(workspace, declare(workspace, archive))


def test_offline_with_a_cold_cache_the_error_names_the_file_and_where_to_put_it(
    workspace, monkeypatch, tmp_path
):
    archive = tmp_path / "no_such_package-1-py3-none-any.whl"
    make_wheel(archive, {"pkg/data/a.txt": "a"})
    asset = declare(workspace, archive)
    for name, value in (("PIP_NO_INDEX", "1"), ("PIP_FIND_LINKS", ""), ("PIP_CONFIG_FILE", "/dev/null")):
        monkeypatch.setenv(name, value)
    with pytest.raises(UserError, match=r"archives/no_such_package-1-py3-none-any.whl.*Put that file there"):
        assets.fetch(workspace, asset)


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """A folder that stands for npm's registry, with one package."""
    archive = tmp_path / "npm" / "@people" / "thing" / "-" / "thing-1.0.0.tgz"
    archive.parent.mkdir(parents=True)
    with tarfile.open(archive, "w:gz") as tar:
        info = tarfile.TarInfo("package/a.tflite")
        info.size = 3
        tar.addfile(info, io.BytesIO(b"abc"))
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (tmp_path / "npm").as_uri() + "/")
    return archive


def declare_npm(workspace, archive, sha256=None):
    package = f"npm:@people/thing@{archive.stem.rpartition('-')[2]}"
    return declare(workspace, archive, ("package/*.tflite",), "package", sha256, package)


def test_a_package_of_npm_comes_from_the_registry_that_the_user_set(workspace, registry):
    folder = assets.fetch(workspace, declare_npm(workspace, registry))
    assert (folder / "a.tflite").read_bytes() == b"abc"
    registry.unlink()
    assert assets.require(workspace, "thing") == folder  # nothing is asked again


def test_a_package_of_npm_that_is_not_the_pinned_one_is_refused(workspace, registry):
    with pytest.raises(UserError, match="SHA-256"):
        assets.fetch(workspace, declare_npm(workspace, registry, sha256="0" * 64))
    assert not (workspace.assets / "thing").exists()


def test_a_package_that_npm_lacks_is_named_and_where_to_put_it(workspace, registry):
    lacking = declare_npm(workspace, registry.with_name("thing-2.0.0.tgz"), sha256="0" * 64)
    with pytest.raises(UserError, match=r"archives/thing-2.0.0.tgz.*Put that file there"):
        assets.fetch(workspace, lacking)


def test_an_unknown_asset_shows_the_near_ones(workspace, tmp_path):
    make_wheel(tmp_path / "a.whl", {"pkg/data/a.txt": "a"})
    declare(workspace, tmp_path / "a.whl")
    with pytest.raises(UserError, match="did you mean thing"):
        assets.find_asset(workspace, "thin")


def test_what_the_project_pins_is_well_formed():
    pinned = assets.load_assets(open_workspace(data=REPOSITORY / "data"))
    assert {"mediapipe", "lpips", "smile", "carphone", "balance"} <= set(pinned)
    for asset in pinned.values():
        assert ("==" in asset.package or asset.package.startswith("npm:")) and asset.licence
        assert asset.archives and all(len(sha256) == 64 for sha256 in asset.archives.values())
