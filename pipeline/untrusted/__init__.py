"""Files that somebody else made, read by code that cannot execute them.

Datasets are downloads. Everything that the project reads from one goes through here:

===============  ====================================================================================
``pickles``      pickles and torch files: arrays, tensors and plain containers; other names are refused
``stubs``        what a pickle is made of while it is read, and the arrays that become of it
``arrays``       ``.npy`` and ``.npz``, also with objects in them
``text``         JSON and plain lists: bounded, without NaN
``onnx_header``  an ONNX model's inputs, outputs and operations, without running it
``bounds``       names that must stay inside their folder; sizes of files, archives and pictures
===============  ====================================================================================

Sizes are bounded before memory is taken, and every error names the file and the remedy.
"""

from pipeline.untrusted.arrays import read_npy, read_npz
from pipeline.untrusted.bounds import GIGABYTE, bounded_bytes, check_picture, inside
from pipeline.untrusted.onnx_header import OnnxHeader, parse_onnx_header
from pipeline.untrusted.pickles import parse_pickle, parse_pickled_arrays, read_pickle, read_torch
from pipeline.untrusted.text import parse_json, read_lines, read_numbers

__all__ = [
    "GIGABYTE", "OnnxHeader", "bounded_bytes", "check_picture", "inside", "parse_json", "parse_onnx_header",
    "parse_pickle", "parse_pickled_arrays",
    "read_lines", "read_npy", "read_npz", "read_numbers", "read_pickle", "read_torch",
]  # fmt: skip
