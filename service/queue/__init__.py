"""The queue: jobs in a table, claimed by workers, repaired by the sweeper, announced by the outbox.

`states` and `wakeups` stand below the tables of `service.store`, the others above them.
"""
