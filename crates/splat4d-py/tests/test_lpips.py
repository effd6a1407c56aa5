"""clients/lpips/convert.py on files as PyTorch writes them, without PyTorch."""
import importlib.util
import io
import json
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[3] / "clients" / "lpips" / "convert.py"


def script():
    spec = importlib.util.spec_from_file_location("lpips_convert", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode = True
    spec.loader.exec_module(module)
    return module


class Storage:
    def __init__(self, key, values):
        self.key, self.values = key, values


class Saved:
    """A tensor that pickles as PyTorch's do."""

    def __init__(self, key, shape, values):
        self.storage, self.shape = Storage(key, values), shape

    def __reduce__(self):
        steps = [1] * len(self.shape)
        for i in range(len(steps) - 1, 0, -1):
            steps[i - 1] = steps[i] * self.shape[i]
        return sys.modules["torch._utils"]._rebuild_tensor_v2, (self.storage, 0, self.shape, tuple(steps), False, OrderedDict())


def dump(state, monkeypatch):
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")

    def rebuild(*_):
        raise AssertionError("the script must not import this")

    rebuild.__name__ = rebuild.__qualname__ = "_rebuild_tensor_v2"
    rebuild.__module__ = "torch._utils"
    utils._rebuild_tensor_v2 = rebuild
    kind = type("FloatStorage", (), {"__module__": "torch"})
    torch.FloatStorage, torch._utils = kind, utils
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "torch._utils", utils)

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if isinstance(value, Storage):
                return "storage", kind, value.key, "cpu", len(value.values)

    out = io.BytesIO()
    Pickler(out, 2).dump(state)
    return out.getvalue()


def floats(values):
    return struct.pack(f"<{len(values)}f", *values)


def test_old_and_new_files_become_one_safetensors(tmp_path, monkeypatch):
    convert = script()
    backbone = OrderedDict({"0.weight": Saved("a", (2, 3), [1, 2, 3, 4, 5, 6]), "0.bias": Saved("b", (2,), [7, 8])})
    data = b"".join(pickle.dumps(x, 2) for x in (convert.MAGIC, 1001, {"little_endian": True}))
    data += dump(backbone, monkeypatch) + pickle.dumps(["a", "b"], 2)
    data += struct.pack("<q", 6) + floats([1, 2, 3, 4, 5, 6]) + struct.pack("<q", 2) + floats([7, 8])
    (tmp_path / "net.pth").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "lin.pth", "w") as archive:
        linear = {"lin0.model.1.weight": Saved("0", (1, 2, 1, 1), [9, 10]), "classifier": Saved("1", (1,), [0])}
        archive.writestr("lin/data.pkl", dump(OrderedDict(linear), monkeypatch))
        archive.writestr("lin/data/0", floats([9, 10]))
        archive.writestr("lin/data/1", floats([0]))
    out = tmp_path / "out.safetensors"
    convert.main([str(tmp_path / "net.pth"), str(tmp_path / "lin.pth"), str(out)])
    data = out.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8:8 + length])
    assert sorted(header) == ["features.0.bias", "features.0.weight", "lin0.model.1.weight"]
    begin, end = header["features.0.weight"]["data_offsets"]
    assert data[8 + length:][begin:end] == floats([1, 2, 3, 4, 5, 6])
    assert header["lin0.model.1.weight"]["shape"] == [1, 2, 1, 1]


def test_files_that_would_run_something_are_refused(tmp_path):
    convert = script()
    (tmp_path / "bad.pth").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(SystemExit, match="system"):
        convert.load(tmp_path / "bad.pth")
    (tmp_path / "text.pth").write_bytes(b"hello")
    with pytest.raises(SystemExit, match="not a file of PyTorch"):
        convert.load(tmp_path / "text.pth")
