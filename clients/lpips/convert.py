#!/usr/bin/env python3
"""Joins PyTorch's files of an LPIPS network into one .safetensors for `splat4d eval --lpips-weights`.

    convert.py BACKBONE.pth LINEAR.pth OUTPUT.safetensors

BACKBONE: torchvision's AlexNet, VGG16 or SqueezeNet 1.1 (alexnet-owt-7be5be79.pth, vgg16-397923af.pth,
squeezenet1_1-b8a52dc0.pth). LINEAR: lpips/weights/v0.1/alex.pth, vgg.pth or squeeze.pth of the PyPI package lpips.
Needs Python only. Pickles are read without running anything: every name except those of tensors is refused.
"""
import io
import json
import os
import pickle
import re
import struct
import sys
import zipfile
from collections import OrderedDict

MAGIC = 0x1950A86A20F9469CFC6C
WIDTHS = {"FloatStorage": 4, "LongStorage": 8}


class Tensor:
    """A view of a storage: name, first number, shape."""

    def __init__(self, storage, first, shape, stride, *_):
        self.storage, self.first, self.shape = storage, first, tuple(shape)
        expected = 1
        for size, step in zip(reversed(self.shape), reversed(tuple(stride))):
            if size > 1 and step != expected:
                raise SystemExit("a tensor is not contiguous: save it with .contiguous()")
            expected *= size
        self.count = expected


class Reader(pickle.Unpickler):
    def find_class(self, module, name):
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return Tensor
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return lambda tensor, *_: tensor
        if module == "torch" and name.endswith("Storage"):
            return name
        raise SystemExit(f"not a file of weights: it names {module}.{name}")

    def persistent_load(self, saved):
        kind, storage, key = saved[:3]
        if kind != "storage" or storage not in WIDTHS:
            raise SystemExit(f"expected numbers of 32 bits, found {storage}")
        return storage, str(key)


def numbers(tensor, storages):
    data, width = storages[tensor.storage[1]], WIDTHS[tensor.storage[0]]
    part = data[width * tensor.first:width * (tensor.first + tensor.count)]
    if len(part) != width * tensor.count:
        raise SystemExit("the file is truncated")
    return part


def load(path):
    """Name -> (shape, little-endian float32 bytes)."""
    with open(path, "rb") as file:
        zipped = zipfile.is_zipfile(file)
        file.seek(0)
        if zipped:
            archive = zipfile.ZipFile(file)
            head = next((n for n in archive.namelist() if n.endswith("/data.pkl")), None)
            if head is None:
                raise SystemExit(f"{path}: not a file of PyTorch")
            state = Reader(io.BytesIO(archive.read(head))).load()
            folder = head[:-len("data.pkl")] + "data/"
            storages = {n[len(folder):]: archive.read(n) for n in archive.namelist() if n.startswith(folder)}
        else:
            try:
                magic = Reader(file).load()
            except pickle.UnpicklingError:
                magic = None
            if magic != MAGIC:
                raise SystemExit(f"{path}: not a file of PyTorch")
            Reader(file).load(), Reader(file).load()  # protocol, system
            state = Reader(file).load()
            keys = [str(key) for key in Reader(file).load()]
            widths = {t.storage[1]: WIDTHS[t.storage[0]] for t in state.values() if isinstance(t, Tensor)}
            storages = {}
            for key in keys:
                (count,) = struct.unpack("<q", file.read(8))
                storages[key] = file.read(widths.get(key, 4) * count)
    # Some files hold the state of `features` alone, whose names begin with numbers.
    return {
        f"features.{name}" if name[0].isdigit() else name: (t.shape, numbers(t, storages))
        for name, t in state.items()
        if isinstance(t, Tensor) and t.storage[0] == "FloatStorage"
    }


def main(arguments):
    if len(arguments) != 3:
        raise SystemExit(__doc__)
    *inputs, output = arguments
    wanted = re.compile(r"(features\..*|net\.slice.*|lin\d\.model\.1\.weight)$")
    tensors = {}
    for path in inputs:
        tensors.update({name: t for name, t in load(path).items() if wanted.match(name)})
    if not any(name.startswith("lin") for name in tensors) or all(name.startswith("lin") for name in tensors):
        raise SystemExit("expected one file with features and one with linear layers")
    header, at = {}, 0
    for name, (shape, data) in sorted(tensors.items()):
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [at, at + len(data)]}
        at += len(data)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    part = f"{output}.part"
    with open(part, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for _, (_, data) in sorted(tensors.items()):
            file.write(data)
    os.replace(part, output)
    print(f"{output}: {len(tensors)} tensors, {at} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
