"""What a file is by how it begins, whatever its name says: pictures, and what lies in the place of one."""

SIGNATURE_BYTES = 32

_SIGNATURES = (
    *((b"\xff\xd8", "JPEG"), (b"\x89PNG\r\n\x1a\n", "PNG"), (b"BM", "BMP")),
    *((start, "TIFF") for start in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    *((b"GIF8", "GIF picture"), (b"\0\0\0\x0cjP  ", "JPEG 2000 picture"), (b"\0\0\0\x0cJXL ", "JPEG XL picture")),
    *((b"8BPS", "Photoshop file"), (b"v/1\x01", "OpenEXR file"), (b"%PDF", "PDF file"), (b"PK\x03\x04", "ZIP archive")),
    *((b"\x1aE\xdf\xa3", "video"), (b"<", "web page or XML file"), (b"version https://git-lfs", "Git LFS pointer")),
)
_HEIC_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}


def kind_of(start: bytes) -> str:
    """What a file is by its first `SIGNATURE_BYTES` bytes; empty where they are of no known kind."""
    if start[:4] == b"RIFF":
        return "WebP" if start[8:12] == b"WEBP" else "video"
    if start[4:8] == b"ftyp":
        # The major brand, a version, then the compatible ones.
        brands = {start[8:12], *(start[at : at + 4] for at in range(16, min(len(start), int.from_bytes(start[:4])), 4))}
        if brands & {b"avif", b"avis"}:
            return "AVIF"
        return "HEIC" if brands & _HEIC_BRANDS else "video"
    return next((kind for signature, kind in _SIGNATURES if start.startswith(signature)), "")
