"""Captures: a subject's named scans."""
