"""What a picture file says of itself, read before anything is decoded: format, size, and whether all of it is there.

Only as much of each format is read as these questions need. A file that lies about its size is met here, where it costs
nothing; the decoder, which would ask for the memory, comes after. Each parser checks the file's end in its format's own
way, since a decoder may fill what is missing with grey.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

from dishmap.errors import ImageError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# JPEG markers that start a frame: all C0..CF but those of tables (DHT, JPG, DAC)
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_EXIF = 0xE1
JPEG_BARE = frozenset((*range(0xD0, 0xD8), 0x01))
TIFF_WIDTH, TIFF_HEIGHT, TIFF_OFFSETS, TIFF_COUNTS, TIFF_TURN, TIFF_DNG = 256, 257, (273, 324), (279, 325), 274, 50706
TIFF_TAGS = frozenset((TIFF_WIDTH, TIFF_HEIGHT, *TIFF_OFFSETS, *TIFF_COUNTS, TIFF_TURN, TIFF_DNG))
# EXIF in JPEG, PNG and WebP is a small TIFF; in JPEG and some WebP files this stands before it
LARGEST_EXIF = 65536
EXIF_START = b"Exif\0\0"
# clockwise turn that EXIF's orientation asks of viewers, degrees; the others are mirror images, which no sensor gives
TURNS_DEG = {3: 180, 6: 90, 8: 270}
# bytes of a TIFF value by its type; the first three unsigned integers are all that these tags use
TIFF_SIZES = {1: 1, 3: 2, 4: 4}
TIFF_CODES = {1: "B", 3: "H", 4: "I"}
# chunks of a PNG and segments of a JPEG number some thousands; a file of nothing else is not searched for minutes
MOST_PARTS = 1_000_000
OTHER_FORMATS = ((b"GIF8", 0, "GIF"), (b"ftyp", 4, "HEIC, AVIF or video"), (b"jP  ", 4, "JPEG 2000"), (b"\xff\x4f\xff\x51", 0, "JPEG 2000"))
READABLE = "PNG, JPEG, TIFF, BMP, WebP and binary PGM or PPM"


@dataclass(frozen=True)
class ImageHeader:
    """Format and size of a picture as stored, before a turn by EXIF.

    coloured: it may hold more than grey. missing: what is not there of a file that is cut short, empty when whole.
    orientation: as EXIF has it, 1 to 8; 1 where nothing is said.
    """

    kind: str
    width_px: int
    height_px: int
    coloured: bool = True
    missing: str = ""
    orientation: int = 1

    @property
    def turn_deg(self) -> int:
        """How far viewers turn the picture clockwise to show it: 0, 90, 180 or 270 degrees."""
        return TURNS_DEG.get(self.orientation, 0)


def read_header(data: bytes) -> ImageHeader:
    """Return the header of a picture file's bytes. Raises ImageError if it is none, or says nothing of its size."""
    for start, parser in PARSERS:
        if data.startswith(start):
            try:
                return parser(data)
            except (struct.error, IndexError, ValueError) as error:
                raise ImageError(f"its header is damaged or cut short; it needs to be a whole picture ({READABLE})") from error
    for start, offset, name in OTHER_FORMATS:
        if data[offset : offset + len(start)] == start:
            raise ImageError(f"it is a {name} file, which is not read here; convert it to PNG or TIFF ({READABLE} are read)")
    raise ImageError(f"it is not a picture; {READABLE} are read")


def _png(data: bytes) -> ImageHeader:
    width, height, _, colour = struct.unpack_from(">IIBB", data, 16)
    if data[12:16] != b"IHDR":
        raise ValueError("no IHDR")
    position, missing, orientation = len(PNG_SIGNATURE), "", 1
    for _ in range(MOST_PARTS):
        if position + 12 > len(data):
            missing = "the end chunk of the PNG"
        if missing or data[position + 4 : position + 8] == b"IEND":
            break
        if data[position + 4 : position + 8] == b"eXIf":
            orientation = _orientation(data[position + 8 :])
        position += 12 + struct.unpack_from(">I", data, position)[0]
    return ImageHeader("PNG", width, height, colour not in (0, 4), missing, orientation)


def _jpeg(data: bytes) -> ImageHeader:
    header: ImageHeader | None = None
    position, marker, orientation = 2, 0, 1
    for _ in range(MOST_PARTS):
        if marker == 0xDA or (header and position + 4 > len(data)):
            break
        if data[position] != 0xFF:
            raise ValueError("no marker")
        marker = data[position + 1]
        if marker == 0xFF or marker in JPEG_BARE:  # padding, or a marker without content
            position += 1 if marker == 0xFF else 2
            continue
        if marker in JPEG_FRAMES and header is None:
            height, width, components = struct.unpack_from(">HHB", data, position + 5)
            header = ImageHeader("JPEG", width, height, components > 1)
        if marker == JPEG_EXIF and data[position + 4 :].startswith(EXIF_START):
            orientation = _orientation(data[position + 4 :])
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    if header is None:
        raise ValueError("no frame before the scan")
    # inside a scan FF is always followed by 00 or a restart, so this finds no end that is none
    whole = data.find(b"\xff\xd9", position) >= 0
    return replace(header, missing="" if whole else "the end marker of the JPEG", orientation=orientation)


def _tiff(data: bytes) -> ImageHeader:
    order = "<" if data.startswith(b"II") else ">"
    tags = _tiff_tags(data, order)
    if TIFF_DNG in tags:
        raise ImageError("it is a raw (DNG) file, which is not read here; develop it to PNG or TIFF")
    if not {TIFF_WIDTH, TIFF_HEIGHT} <= tags.keys():
        raise ValueError("no size")
    missing = ""
    for offsets, lengths in zip(TIFF_OFFSETS, TIFF_COUNTS, strict=True):
        ends = (a + b for a, b in zip(tags.get(offsets, ()), tags.get(lengths, ()), strict=False))
        if max(ends, default=0) > len(data):
            missing = "strips of the TIFF"
    return ImageHeader("TIFF", tags[TIFF_WIDTH][0], tags[TIFF_HEIGHT][0], missing=missing, orientation=tags.get(TIFF_TURN, (1,))[0])


def _orientation(data: bytes) -> int:
    """The orientation in EXIF data at the start of these bytes; 1 where it has none or is damaged, as the picture itself may be whole."""
    exif = data.removeprefix(EXIF_START)[:LARGEST_EXIF]
    try:
        return _tiff_tags(exif, "<" if exif.startswith(b"II") else ">").get(TIFF_TURN, (1,))[0]
    except (struct.error, IndexError, ValueError):
        return 1


def _tiff_tags(data: bytes, order: str) -> dict[int, tuple[int, ...]]:
    """Values of the tags that matter here, from the first directory."""
    (position,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, position)
    tags: dict[int, tuple[int, ...]] = {}
    for entry in range(position + 2, position + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
        if tag not in TIFF_TAGS or tag in tags or kind not in TIFF_SIZES:
            continue
        inline = TIFF_SIZES[kind] * number <= 4
        at = entry + 8 if inline else struct.unpack_from(order + "I", data, entry + 8)[0]
        if at + TIFF_SIZES[kind] * number > len(data):
            raise ValueError("a table beyond the end")
        tags[tag] = struct.unpack_from(f"{order}{number}{TIFF_CODES[kind]}", data, at)
    return tags


def _bmp(data: bytes) -> ImageHeader:
    start, size = struct.unpack_from("<II", data, 10)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        packed = 0
    else:
        width, height, _, bits, packed = struct.unpack_from("<iiHHI", data, 18)
    row = (width * bits + 31) // 32 * 4
    whole = packed != 0 or start + row * abs(height) <= len(data)
    # a negative height means rows from the top
    return ImageHeader("BMP", width, abs(height), missing="" if whole else "rows of the BMP")


def _webp(data: bytes) -> ImageHeader:
    (size,) = struct.unpack_from("<I", data, 4)
    if data[8:12] != b"WEBP":
        raise ImageError(f"it is a RIFF file but not a picture; {READABLE} are read")
    form = data[12:16]
    if form == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        height = 1 + int.from_bytes(data[27:30], "little")
    elif form == b"VP8L":
        (packed,) = struct.unpack_from("<I", data, 21)
        width, height = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    elif form == b"VP8 ":
        width, height = (value & 0x3FFF for value in struct.unpack_from("<HH", data, 26))
    else:
        raise ValueError("unknown WebP")
    missing = "" if size + 8 <= len(data) else "the end of the WebP"
    return ImageHeader("WebP", width, height, missing=missing, orientation=_webp_orientation(data))


def _webp_orientation(data: bytes) -> int:
    position = 12
    for _ in range(MOST_PARTS):
        if position + 8 > len(data):
            break
        if data[position : position + 4] == b"EXIF":
            return _orientation(data[position + 8 :])
        (length,) = struct.unpack_from("<I", data, position + 4)
        position += 8 + length + length % 2
    return 1


def _pnm(data: bytes) -> ImageHeader:
    """PGM (P5) or PPM (P6): magic, width, height, largest value, one white space, then the pixels."""
    fields: list[int] = []
    position = 2
    while len(fields) < 3:
        if data[position : position + 1] == b"#":
            position = data.index(b"\n", position)
        elif data[position : position + 1].isspace():
            position += 1
        else:
            end = position
            while data[end : end + 1].isdigit() and end - position < 10:
                end += 1
            fields.append(int(data[position:end]))
            position = end
    width, height, largest = fields
    channels = 3 if data.startswith(b"P6") else 1
    whole = position + 1 + width * height * channels * (2 if largest > 255 else 1) <= len(data)
    return ImageHeader("PNM", width, height, channels == 3, "" if whole else "pixels of the PGM or PPM")


PARSERS: tuple[tuple[bytes, Callable[[bytes], ImageHeader]], ...] = (
    (PNG_SIGNATURE, _png),
    (b"\xff\xd8\xff", _jpeg),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
    (b"BM", _bmp),
    (b"RIFF", _webp),
    (b"P5", _pnm),
    (b"P6", _pnm),
)
