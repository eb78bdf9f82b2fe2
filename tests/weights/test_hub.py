"""Downloads, with the real client against a server on this machine that answers as the hub does."""

import http.server
import json
import threading
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from logvggt_jax.errors import InputError
from logvggt_jax.weights import open_state_dict, read_provenance
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.files import find_weights
from logvggt_jax.weights.hub import download

constants = pytest.importorskip("huggingface_hub.constants", reason="extra `hub` is not installed")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub:
    """Serves `files` ("owner/name/file" -> bytes) under `licence` and records the requests."""

    def __init__(self):
        self.files, self.requests, self.licence = {}, [], "cc-by-nc-4.0"
        hub = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_HEAD(self):
                hub.answer(self, body=False)

            def do_GET(self):
                hub.answer(self, body=True)

            def log_message(self, format, *args):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()

    def answer(self, handler, body):
        self.requests.append((handler.command, handler.path))
        if handler.path.startswith("/api/models/"):
            self.describe(handler, handler.path.removeprefix("/api/models/"))
            return
        repository, _, file = handler.path.lstrip("/").partition("/resolve/main/")
        content = self.files.get(f"{repository}/{file}")
        known = any(name.startswith(f"{repository}/") for name in self.files)
        handler.send_response(200 if content is not None else 404)
        handler.send_header("X-Repo-Commit", COMMIT)
        handler.send_header("Content-Length", str(len(content or b"")))
        if content is None:
            handler.send_header("X-Error-Code", "EntryNotFound" if known else "RepoNotFound")
        else:
            handler.send_header("ETag", f'"{hash(content):x}"')
        handler.end_headers()
        if body and content is not None:
            handler.wfile.write(content)

    def describe(self, handler, repository):
        names = [name.removeprefix(f"{repository}/") for name in self.files if name.startswith(f"{repository}/")]
        siblings = [{"rfilename": name} for name in names]
        description = {"id": repository, "siblings": siblings, "cardData": {"license": self.licence}}
        content = json.dumps(description).encode()
        handler.send_response(200 if names else 404)
        if not names:
            handler.send_header("X-Error-Code", "RepoNotFound")
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture
def hub(tmp_path, monkeypatch):
    server = Hub()
    # The client reads HF_ENDPOINT into these when it is imported.
    template = constants.HUGGINGFACE_CO_URL_TEMPLATE.replace(constants.ENDPOINT, server.url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "ENDPOINT", server.url)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    yield server
    server.close()


def test_safetensors_come_first_and_are_cached(hub):
    content = save({"w": np.arange(4, dtype=np.float32)})
    hub.files = {"owner/vggt/model.safetensors": content, "owner/vggt/model.pt": b"pickle"}
    path = download("owner/vggt")
    assert path.name == "model.safetensors" and path.read_bytes() == content
    assert resolve("owner/vggt") == path
    assert sum(method == "GET" and "/resolve/" in url for method, url in hub.requests) == 1
    assert not any("model.pt" in requested for _, requested in hub.requests)


def test_the_pickle_is_taken_where_there_is_nothing_else(hub):
    hub.files = {"owner/vggt/model.pt": b"pickle"}
    assert download("owner/vggt").read_bytes() == b"pickle"


def test_the_only_checkpoint_is_taken_whatever_its_name(hub):
    hub.files = {"owner/vggt/README.md": b"text", "owner/vggt/vggt_1B_commercial.pt": b"pickle"}
    assert download("owner/vggt").read_bytes() == b"pickle"


def test_of_several_checkpoints_the_user_chooses(hub):
    hub.files = {"owner/vggt/large.pt": b"large", "owner/vggt/small/weights.safetensors": b"small"}
    with pytest.raises(
        InputError, match=r"several checkpoints, large\.pt, small/weights\.safetensors; give one as hf:owner/vggt/large"
    ):
        download("owner/vggt")
    assert resolve("hf:owner/vggt/small/weights.safetensors").read_bytes() == b"small"
    with pytest.raises(FileNotFoundError, match=r"owner/vggt: the repository holds no medium\.pt"):
        resolve("hf:owner/vggt/medium.pt")


def test_weights_from_the_hub_are_vggts_under_the_repositorys_licence(hub):
    hub.files = {"owner/vggt/model.pt": b"pickle"}
    provenance = read_provenance("hf:owner/vggt")
    assert provenance.trained_for == "vggt" and provenance.licence == "cc-by-nc-4.0"
    assert "owner/vggt" in provenance.source


def test_a_cached_file_serves_offline(hub):
    hub.files = {"owner/vggt/model.safetensors": b"weights"}
    path = download("owner/vggt")
    hub.close()
    assert download("owner/vggt") == path


def test_a_download_is_announced_once_before_it_begins(hub, capsys):
    hub.files = {"owner/vggt/model.safetensors": b"weights" * 1_000_000}
    download("owner/vggt")
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("downloading")]
    assert lines == [f"downloading owner/vggt/model.safetensors, 7.0 MB, from {hub.url}"]
    assert captured.out == ""
    download("owner/vggt")
    assert "downloading" not in capsys.readouterr().err


def test_an_index_brings_its_shards(hub):
    index = {"weight_map": {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}}
    hub.files = {"owner/vggt/model.safetensors.index.json": json.dumps(index).encode()}
    for name, value in zip(index["weight_map"], (1, 2), strict=True):
        content = save({name: np.full(2, value, np.float32)})
        hub.files[f"owner/vggt/{index['weight_map'][name]}"] = content
    with open_state_dict(resolve("hf:owner/vggt")) as found:
        assert {name: found[name][0] for name in found} == {"a": 1, "b": 2}


def test_the_caches_own_folder_of_a_repository_is_read_as_a_path(hub, tmp_path):
    hub.files = {"owner/vggt/model.safetensors": save({"w": np.ones(1, np.float32)})}
    path = download("owner/vggt")
    hub.close()
    folder = tmp_path / "cache" / "models--owner--vggt"
    assert resolve(folder) == path.parent
    with open_state_dict(path.resolve()) as found:  # a blob, which has no suffix
        assert list(found) == ["w"]


def test_an_unreachable_hub_is_named(hub, monkeypatch):
    hub.close()
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda seconds: None)  # between attempts
    with pytest.raises(FileNotFoundError, match=r"owner/vggt: no such path here, the hub cannot be reached"):
        download("owner/vggt")


def test_an_unknown_repository_and_one_without_weights_are_named(hub):
    hub.files = {"owner/other/README.md": b"text"}
    with pytest.raises(FileNotFoundError, match=r"owner/vggt: no such repository on the hub"):
        download("owner/vggt")
    with pytest.raises(FileNotFoundError, match=r"owner/other on the hub: no file of weights .*holds README\.md"):
        download("owner/other")


def test_a_path_that_exists_is_never_a_repository(hub, tmp_path, monkeypatch):
    (tmp_path / "owner" / "vggt").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert resolve("owner/vggt").is_dir()
    with pytest.raises(FileNotFoundError, match=r"owner/vgtt: no such file or folder"):
        resolve("owner/vgtt")  # a slip of the keyboard asks no server
    with pytest.raises(FileNotFoundError, match=r"owner/vggt\.safetensors: no such file"):
        resolve("owner/vggt.safetensors")
    with pytest.raises(FileNotFoundError, match=r"a/b/c: no such file"):
        resolve("a/b/c")
    for text in ("./owner/vgtt", "../owner/vgtt", "/owner/vgtt", "~/owner-of-nothing", "other/vggt.ckpt", "a/b/c"):
        with pytest.raises(FileNotFoundError, match="no such file or folder"):
            resolve(text)
    with pytest.raises(FileNotFoundError, match=r"hf:vggt: no address on the hub; expected hf:owner/name"):
        resolve("hf:vggt")
    for url, written in (
        ("https://huggingface.co/facebook/VGGT-1B/resolve/main/model.pt", "hf:facebook/VGGT-1B"),
        ("ftp://example.org/model.pt", "hf:owner/name"),
    ):
        with pytest.raises(FileNotFoundError, match=rf"^{url}: a checkpoint is a file .* the hub, written {written};"):
            resolve(url)
    Path("loop").symlink_to("loop")
    with pytest.raises(FileNotFoundError, match="loop: a link that leads to nothing, or to itself"):
        find_weights(resolve("loop"))
    with pytest.raises(FileNotFoundError, match=r"stranger/vggt: no such file or folder"):
        resolve(Path("stranger/vggt"))  # whoever has a path says so
    with pytest.raises(FileNotFoundError, match=r"did you mean owner/vggt\?"):
        resolve("owner/vgtt")
    with pytest.raises(FileNotFoundError, match=r"did you mean owner/vggt\?"):
        resolve("./ownr/vggt")
    assert hub.requests == []
