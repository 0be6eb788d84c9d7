"""Subjects: the people."""
