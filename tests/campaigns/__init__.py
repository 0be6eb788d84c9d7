"""Test campaigns: each runs the product hard from outside, prints a tally and exits with a code."""
