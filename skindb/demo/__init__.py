"""The demo: virtual subjects, from photographs to a report."""

from skindb.demo.run import run_demo

__all__ = ["run_demo"]
