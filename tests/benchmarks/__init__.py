"""Studies that take longer than tests may: `python -m tests.benchmarks.NAME`. They compute on the product's threads."""

from controller.cli import use_one_thread

use_one_thread()
