"""Records: the audit log and the receipts of deletions."""
