"""The encodings of text files that people's programs write. Imports nothing heavy: settings are read so."""

from __future__ import annotations

import codecs


def decode_text(content: bytes, errors: str = "strict") -> str:
    """Text as people's programs write it: UTF-8, or UTF-16 where a byte-order mark says so; without the mark.

    Args:
        errors: what becomes of bytes that are no text, as for ``bytes.decode``.

    Raises:
        UnicodeDecodeError: it is no such text.
    """
    wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return content.decode("utf-16" if wide else "utf-8-sig", errors=errors)
