"""Files from elsewhere: what is no ordinary file is not read, what a header claims is not believed, nothing runs."""

import io
import os
import warnings
import zipfile

import numpy as np
import pytest
import torch

from ihbench.errors import BadInput
from ihbench.files.name_pattern import NamePattern
from ihbench.files.npz import read_npz
from ihbench.files.regular import read_bytes, read_text, read_toml
from ihbench.files.tensors import read_tensors

READERS = {
    "bytes": read_bytes,
    "text": read_text,
    "toml": lambda path: read_toml(path, "a file"),
    "npz": read_npz,
    "pth": read_tensors,
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "No such file"),
        (lambda path: path.mkdir(), "a folder"),
        (os.mkfifo, "a device, a pipe or a socket"),
        (lambda path: path.symlink_to("/dev/zero"), "a device"),
        (lambda path: path.symlink_to(path.name), "symbolic links"),
    ],
    ids=["gone", "folder", "pipe", "endless", "loop"],
)
def test_what_is_no_ordinary_file_is_not_read(read, make, words, tmp_path):
    make(tmp_path / "x")
    with pytest.raises(BadInput, match=rf"x: .*{words}"):
        read(tmp_path / "x")


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "x").open("wb") as file:
        file.truncate(2**40)  # takes no room
    with pytest.raises(BadInput, match="larger than 256 MiB"):
        read_text(tmp_path / "x")


def entry(shape, data=b"", kind="<f8"):
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def archive(*entries):
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        warnings.simplefilter("ignore")  # of a name that is there twice
        for name, data in entries:
            file.writestr(name, data)
    return buffer.getvalue()


def pickled():
    buffer = io.BytesIO()
    np.savez(buffer, a=np.array([{"x": 1}], object))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (archive(("a.npy", entry((10**12,)))), "an array of 8000000000000 bytes; expected at most"),
        (archive(("a.npy", entry((2**20, 2**20, 2**20, 2**20)))), "an array of .* bytes"),
        (archive(("a.npy", entry((3,), bytes(8)))), "promises 24 bytes, which is not what follows"),
        (archive(("a.npy", entry((1,), bytes(16)))), "promises 8 bytes, which is not what follows"),
        (archive(("a.npy", entry((), bytes(8))), ("a.npy", entry((), bytes(8)))), "two arrays 'a'"),
        (archive(("a.npy", entry((2**18,), bytes(2**21)))), "an array of 2097[0-9]* bytes; expected at most 1048576"),
        (archive(("a.npy", entry((-1,)))), "header is damaged"),
        (archive(("a.npy", entry((1,), bytes(8), "<M8[s]"))), "expected numbers or text, found datetime64"),
        (archive(("a.npy", b"\x93NUMPY\x09\x00"))[:-4], "cannot be read as a .npz"),
        (archive(("a.npy", entry((1,), bytes(8)))).replace(b"\x08\x00", b"\x63\x00"), "cannot be read as a .npz"),
        (pickled(), "found object"),
        (b"PK\x05\x06", "cannot be read as a .npz"),
        (b"", "cannot be read as a .npz"),
    ],
)
def test_an_npz_that_claims_too_much_or_is_damaged_is_refused(data, words, tmp_path):
    (tmp_path / "x.npz").write_bytes(data)
    with pytest.raises(BadInput, match=rf"x\.npz.*{words}"):
        read_npz(tmp_path / "x.npz", largest=2**20)


def test_an_npz_comes_back_as_numpy_reads_it(tmp_path):
    arrays = {
        "a": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "b": np.array("text"),
        "c": np.zeros((0, 3), ">i4"),
    }
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    with np.load(tmp_path / "x.npz") as theirs:
        for name, array in read_npz(tmp_path / "x.npz").items():
            np.testing.assert_array_equal(array, theirs[name])
            assert (array.shape, array.dtype.kind) == (theirs[name].shape, theirs[name].dtype.kind)
    assert set(read_npz(tmp_path / "x.npz", ["b", "z"])) == {"b"}


class Payload:
    def __reduce__(self):
        return os.mkdir, ("it-ran",)

    def __repr__(self):
        return "Payload()"


@pytest.mark.parametrize("value", [[1], torch.zeros(2), {1: torch.zeros(2)}, {"a": Payload()}, Payload()], ids=str)
def test_what_torch_saved_is_a_dictionary_of_tensors_or_refused(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(value, tmp_path / "x.pth")
    with pytest.raises(BadInput, match=r"x\.pth: (not a file of plain tensors|expected a dictionary)"):
        read_tensors(tmp_path / "x.pth")
    assert not (tmp_path / "it-ran").exists()


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("", "expected a pattern"),
        ("{frame:10000000000d}", "may be padded to 32 digits"),
        ("{frame:033d}", "may be padded to 32 digits"),
        ("{frame:{index}d}", "a { alone|cannot be filled in"),
        ("{frame!r}", "no placeholder {frame!r}"),
        ("{frame.real}", "no placeholder"),
        ("{scene:5}", "it is no number"),
        ("{}", "no placeholder"),
        ("a}", "a } alone"),
        ("~/{frame}", "leads out of the folder"),
        ("a/../../{frame}", "leads out of the folder"),
        ("x" * 300 + "{frame}", "a name of 301 bytes"),
        ("{frame}\0", "zero byte"),
    ],
)
def test_patterns_of_names_are_bounded(pattern, words):
    with pytest.raises(BadInput, match=words):
        NamePattern.parse(pattern, ["frame", "index"], ["scene"]).name({"frame": 7, "index": 1, "scene": "s"})


def test_patterns_are_filled_in_as_python_does():
    values = {"frame": 7, "index": 123, "scene": "s{x}"}
    for pattern in ("{scene}/{frame:06d}.png", "{{{index:02d}}}{frame:d}{frame:03}", "{index}"):
        assert NamePattern.parse(pattern, ["frame", "index"], ["scene"]).name(values) == pattern.format(**values)
