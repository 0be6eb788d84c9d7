"""Planted faults: check that a suite still notices what it noticed before.

Before tests are merged, moved or shortened, and after, every fault of ``faults.toml`` (a sign, a
bound, a missing await, a tenant filter, a fence, a unit) is planted in a scratch copy of the tree,
one at a time, and the suites that could notice are run until one fails. The two tables, compared,
say what was lost: ``python -m tests.campaigns.faults --root TREE --json FILE``.
"""
