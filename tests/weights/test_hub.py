"""Downloads, with the real client against a server on this machine that answers as the hub does."""

import http.server
import threading

import numpy as np
import pytest
from safetensors.numpy import save

from logvggt_jax.weights.hub import download, resolve

constants = pytest.importorskip("huggingface_hub.constants")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub:
    """Serves `files` ("owner/name/file" -> bytes) and records the requests."""

    def __init__(self):
        self.files, self.requests = {}, []
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
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def answer(self, handler, body):
        self.requests.append((handler.command, handler.path))
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


def test_a_cached_file_serves_offline(hub):
    hub.files = {"owner/vggt/model.safetensors": b"weights"}
    path = download("owner/vggt")
    hub.close()
    assert download("owner/vggt") == path


def test_an_unreachable_hub_is_named(hub, monkeypatch):
    hub.close()
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda seconds: None)  # between attempts
    with pytest.raises(FileNotFoundError, match=r"owner/vggt: the hub cannot be reached"):
        download("owner/vggt")


def test_an_unknown_repository_and_one_without_weights_are_named(hub):
    hub.files = {"owner/other/README.md": b"text"}
    with pytest.raises(FileNotFoundError, match=r"owner/vggt: no such repository on the hub"):
        download("owner/vggt")
    with pytest.raises(
        FileNotFoundError, match=r"owner/other: the repository holds no model\.safetensors or model\.pt"
    ):
        download("owner/other")


def test_a_path_that_exists_is_never_a_repository(hub, tmp_path, monkeypatch):
    (tmp_path / "owner" / "vggt").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert resolve("owner/vggt").is_dir()
    with pytest.raises(FileNotFoundError, match=r"owner/vggt\.safetensors: no such file"):
        resolve("owner/vggt.safetensors")
    with pytest.raises(FileNotFoundError, match=r"a/b/c: no such file"):
        resolve("a/b/c")
    assert hub.requests == []
