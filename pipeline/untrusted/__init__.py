"""Files that somebody else made, read by code that cannot execute them.

Datasets are downloads. Everything that the project reads from one goes through here:

=============  =====================================================================================
``pickles``    pickles: numpy arrays, torch tensors and plain containers; any other name is refused
``torch_files``  what ``torch.save`` wrote, zip or legacy
``arrays``     ``.npy`` and ``.npz``, also with objects in them
``pictures``   the size that a picture claims, looked at before it is decoded
``texts``      JSON and plain lists: bounded, without NaN
``paths``      names in files that must stay inside their folder
=============  =====================================================================================

Sizes are bounded before memory is taken, and every error names the file and the remedy.
"""

from pipeline.untrusted.arrays import read_npy, read_npz
from pipeline.untrusted.paths import bounded_bytes, inside
from pipeline.untrusted.pickles import read_pickle
from pipeline.untrusted.pictures import check_picture
from pipeline.untrusted.texts import parse_json, read_lines, read_numbers
from pipeline.untrusted.torch_files import read_torch

__all__ = [
    "bounded_bytes", "check_picture", "inside", "parse_json", "read_lines", "read_npy", "read_npz",
    "read_numbers", "read_pickle", "read_torch",
]  # fmt: skip
