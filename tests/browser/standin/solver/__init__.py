"""Puts a stand-in for `solver.pipeline` before the real package, by PYTHONPATH."""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)
