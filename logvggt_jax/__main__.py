"""`python -m logvggt_jax` is the `logvggt` command."""

import sys

from logvggt_jax.cli import main

sys.exit(main())
