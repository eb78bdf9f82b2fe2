"""The data sets as text for people: what each needs, where it comes from and under which licence."""

import textwrap

from logvggt_jax.data.dataset import Reader
from logvggt_jax.data.registry import READERS
from logvggt_jax.errors import install_line

UNPACKING = "Archives are never unpacked by this package: unpack them with your own tools, as each entry says."


def catalogue(width: int = 100) -> str:
    """Every data set that `open_dataset` knows, in the order of `DATASETS`, as lines of up to `width` characters."""
    entries = [_entry(reader, width) for reader in READERS.values()]
    return "\n\n".join([*entries, textwrap.fill(UNPACKING, width)])


def _entry(reader: type[Reader], width: int) -> str:
    about = reader.about
    scale = "metres" if reader.metric else "not metric, each sequence has a scale of its own"
    fields = {
        "for": f"{' and '.join(about.roles)}; splits {', '.join(reader.splits)}; {scale}",
        "folder": reader.expects,
        "obtain": about.source,
        "licence": about.licence,
        "size": about.size,
    }
    if about.extra:
        fields["install"] = install_line(about.extra)
    lines = [f"{reader.name}: {reader.title}"]
    for key, value in fields.items():
        lines += textwrap.wrap(
            value, width, initial_indent=f"  {key:<9}", subsequent_indent=" " * 11, break_on_hyphens=False
        )
    return "\n".join(lines)
