"""Reads files with one recording, whatever their format: each has a module in data/files.

Nothing is unpickled. An ambiguous file is refused, and the message gives the option that decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import h5py

from palpate.core.errors import FormatError
from palpate_train.data.files import (
    bags,
    hdf5,
    json_lines,
    matlab,
    numpy_files,
    octave,
    parquet,
    sheets,
    tdms,
    tekscan,
    text,
    zarr_store,
)
from palpate_train.data.files.table import ReadPlan, Table
from palpate_train.data.readers import HDF5

Reader = Callable[[Path, ReadPlan], Table]
BINARY: Mapping[tuple[str, ...], Reader] = {
    (".npy",): numpy_files.read_npy,
    (".npz",): numpy_files.read_npz,
    (".mat",): matlab.read,
    HDF5: hdf5.read,
    sheets.SUFFIXES: sheets.read,
    parquet.SUFFIXES: parquet.read,
    (".tdms",): tdms.read,
    bags.SUFFIXES: bags.read,
    zarr_store.SUFFIXES: zarr_store.read,
}
"""Readers by the suffixes of their files. Other files are HDF5 or text."""
POINTER = b"version https://git-lfs"
AGAIN = "if it was cut off, copy or record it again"
REMEDIES = {
    (
        ".pkl",
        ".pickle",
        ".joblib",
    ): "a pickle, which can run any program; save arrays with numpy.savez",
    (".pt", ".pth"): "a file of PyTorch; save the tensor with numpy.save(path, tensor.numpy())",
    (".rds", ".rdata", ".rda"): "a file of R; save the table with write.csv",
    (".zip", ".gz", ".bz2", ".xz", ".zst", ".7z", ".tar", ".tgz", ".rar"): "packed; unpack it",
    (".ts", ".tsf", ".arff"): "a set of series; save its arrays with numpy.savez, one a recording",
    (".sav", ".dta", ".sas7bdat"): "a file of a statistics program; export it as CSV",
    (".ulg", ".tlog"): "a flight log; export it as CSV",
    (".wav", ".flac", ".mp3"): "a sound; export its samples as CSV or .npy",
    (".mp4", ".avi", ".mkv", ".mov", ".png", ".jpg", ".jpeg", ".gif", ".tif", ".tiff", ".bmp"): (
        "a picture or a video; export the counts as CSV or .npy"
    ),
    (".pdf", ".doc", ".docx"): "a document; export the numbers as CSV",
    (".fig",): (
        "a figure of MATLAB; there: l = findobj(gca, 'Type', 'line'); "
        "skin = vertcat(l.YData)'; save('skin.mat', 'skin', '-v7')"
    ),
    (".fsx", ".sens", ".fpx"): "Tekscan's own format; export it as ASCII (.asf)",
    (".edf", ".bdf", ".gdf"): "a biosignal recording; export it as CSV",
    (".slx", ".m", ".mlx", ".mlapp"): "a program of MATLAB; save its data with -v7",
    (".lvbit", ".vi"): "a program of LabVIEW; save its data as .lvm or .tdms",
    (".nc", ".cdf"): "netCDF of version 3; export the array as HDF5 or .npy",
}
"""What to do with formats that we do not read, by suffix."""
MAGIC = {
    b"PK\x03\x04": "a zip archive; give it the suffix of its format, such as .xlsx or .npz",
    b"\x1f\x8b": "packed with gzip; unpack it",
    b"BZh": "packed with bzip2; unpack it",
    b"\xfd7zXZ": "packed with xz; unpack it",
    b"RIFF": "a sound or a video; export its samples as CSV or .npy",
    b"<!DOCTYPE": "a web page; download the file itself",
    b"<html": "a web page; download the file itself",
    b"%PDF": "a document; export the numbers as CSV",
    b"\x89PNG": "a picture; export the counts as CSV or .npy",
    b"PAR1": "a Parquet file; give it the suffix .parquet",
    b"\x89MCAP": "a recording of ROS 2; give it the suffix .mcap",
    b"#ROSBAG": "a recording of ROS 1; give it the suffix .bag",
    b"SQLite format 3": "a database; a recording of ROS 2 has the suffix .db3",
    b"RRF": "a recording of Rerun; query it with rerun.dataframe, and save the table as Parquet",
    b"TDSm": "a TDMS file; give it the suffix .tdms",
    b"\x93NUMPY": "an array of NumPy; give it the suffix .npy",
    b"Octave-1": "in Octave's binary format; save it with -hdf5, -v7 or as text",
    b"MATLAB 5.0": "a MAT file; give it the suffix .mat",
    b"\xd0\xcf\x11\xe0": "an old file of Office; give it the suffix .xls, or export it as CSV",
}
"""What to do with files whose content differs from their suffix, by their first bytes."""


def read(path: Path, wanted: ReadPlan | None = None) -> Table:
    """The recording in a file. Raises FormatError whose message does not repeat the file's name."""
    try:
        return _read(path, wanted or ReadPlan())
    except FormatError:
        raise
    except Exception as e:  # libraries raise errors of any type for damaged files
        why = " ".join(str(e).split()) or repr(e)
        if "plugin" in why or "filter" in why:
            raise FormatError(
                f"is packed with a filter that is not here ({why}); repack it: h5repack -f GZIP=1"
            ) from e
        raise FormatError(f"cannot be read: {why}; {AGAIN}") from e


def arrays_of(path: Path) -> tuple[str, ...]:
    """The names of the arrays of frames in a MAT, .npz or HDF5 file. Raises FormatError, also for a
    file of another kind, which is not read."""
    suffix = path.suffix.lower()
    if not (suffix in (".npz", ".mat", *HDF5) or h5py.is_hdf5(path)):
        raise FormatError("holds no named arrays; --variable takes a name there, and no pattern")
    return read(path, ReadPlan(names_only=True)).beside


def _read(path: Path, wanted: ReadPlan) -> Table:
    suffix = path.suffix.lower()
    if path.is_file():
        with path.open("rb") as f:
            if f.read(len(POINTER)) == POINTER:
                raise FormatError("is a pointer of Git LFS; fetch its content with git lfs pull")
    reader = next((read for suffixes, read in BINARY.items() if suffix in suffixes), None)
    if zarr_store.is_store(path):
        reader = zarr_store.read
    if reader:
        return reader(path, wanted)
    if h5py.is_hdf5(path):
        return hdf5.read(path, wanted)
    if remedy := next((why for suffixes, why in REMEDIES.items() if suffix in suffixes), ""):
        raise FormatError(f"is {remedy}")
    data = path.read_bytes()
    if remedy := next((why for magic, why in MAGIC.items() if data.startswith(magic)), ""):
        raise FormatError(f"is {remedy}")
    if suffix in json_lines.SUFFIXES or (data[:1] == b"{" and data[1:2] != b"'"):
        return json_lines.read(data, wanted)
    content, notes = text.decoded(data)
    lines = text.lines_of(content)
    if octave.wrote(lines):
        return octave.read(lines, wanted)
    if tekscan.is_movie(lines):
        return tekscan.read(lines, wanted, notes)
    return text.table(lines, wanted, notes)
