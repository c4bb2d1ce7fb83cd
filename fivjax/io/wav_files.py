"""Samples of WAV files: RIFF, its variant with the high byte first (RIFX), and RF64 for more than 4 GB.

A file is a row of chunks, each with a name, a length and its content: `fmt ` says what a sample is, `data` holds them
(Microsoft, Multimedia Programming Interface and Data Specifications 1.0; EBU Tech 3306 for RF64).
"""

from pathlib import Path

import numpy as np

from .reading_limits import check_length, unreadable

KIND = "WAV"
PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE


def read_wav(path: Path) -> tuple[float, np.ndarray]:
    """The sampling rate in Hz and the samples, `(T, tracks)`: floating-point numbers as they are, others over their full scale.

    **Raises:** `ValueError` for a file that is damaged, or compressed.
    """
    check_length(path)
    content = path.read_bytes()
    order = {b"RIFF": "little", b"RF64": "little", b"RIFX": "big"}.get(content[:4])
    if order is None or content[8:12] != b"WAVE":
        raise unreadable(path, KIND, "it does not begin as a WAV file does")

    def number(begin: int, size: int) -> int:
        if begin + size > len(content):
            raise unreadable(path, KIND, "it is cut off")
        return int.from_bytes(content[begin : begin + size], order)

    form = data = long_data = None
    at = 12
    # A length that stands for "to the end of the file", or, in RF64, for one that the chunk `ds64` holds.
    unknown = 0xFFFFFFFF
    while data is None and at < len(content):
        name, size, begin = content[at : at + 4], number(at + 4, 4), at + 8
        if name == b"data" and size == unknown:
            size = len(content) - begin if long_data is None else long_data
        if begin + size > len(content):
            raise unreadable(
                path, KIND, f"a chunk of {size} bytes begins at byte {at}, but {len(content) - begin} bytes follow"
            )
        if name == b"ds64":
            long_data = number(begin + 8, 8)
        elif name == b"fmt ":
            if size < 16:
                raise unreadable(path, KIND, "its format is cut off")
            form = {
                "code": number(begin, 2),
                "tracks": number(begin + 2, 2),
                "rate": number(begin + 4, 4),
                "block": number(begin + 12, 2),
                "bits": number(begin + 14, 2),
            }
            if form["code"] == EXTENSIBLE and size >= 28:
                form["code"] = number(begin + 24, 4)
        elif name == b"data":
            data = content[begin : begin + size]
        at = begin + size + size % 2
    if form is None or data is None:
        raise unreadable(path, KIND, f"it has no {'format' if form is None else 'samples'}")
    return float(form["rate"]), _samples(path, data, form, order)


def _samples(path: Path, data: bytes, form: dict[str, int], order: str) -> np.ndarray:
    code, tracks, bits, width = form["code"], form["tracks"], form["bits"], form["block"] // max(form["tracks"], 1)
    if code not in (PCM, FLOAT) or (code == FLOAT and bits not in (32, 64)):
        raise unreadable(path, KIND, f"its samples are of format {code} with {bits} bits: compressed, or not known")
    if (
        tracks == 0
        or form["rate"] == 0
        or not 0 < bits <= 64
        or width != (bits + 7) // 8
        or width * tracks != form["block"]
    ):
        raise unreadable(
            path,
            KIND,
            f"it declares {tracks} tracks of {bits} bits in {form['block']} bytes, {form['rate']} times a second",
        )
    if len(data) % form["block"]:
        raise unreadable(
            path, KIND, f"its last sample is cut off: {len(data)} bytes are no multiple of {form['block']}"
        )
    mark = "<" if order == "little" else ">"
    if code == FLOAT:
        samples = np.frombuffer(data, f"{mark}f{width}").astype(float)
    elif width == 1:
        # Unsigned; it rests at 128.
        samples = (np.frombuffer(data, np.uint8).astype(float) - 128.0) / 128.0
    else:
        # Samples fill their bytes from the top. As the top of 32 or 64 bits, the sign comes by itself.
        whole = 4 if width <= 4 else 8
        padded = np.zeros((len(data) // width, whole), np.uint8)
        padded[:, whole - width :] = np.frombuffer(data, np.uint8).reshape(-1, width)[
            :, :: 1 if order == "little" else -1
        ]
        samples = padded.view(f"<i{whole}")[:, 0].astype(float) / 2.0 ** (8 * whole - 1)
    return samples.reshape(-1, tracks)
