"""Command line, client and demonstration of Myoface: anatomical faces from 3D scans."""

__version__ = "0.1.0"
