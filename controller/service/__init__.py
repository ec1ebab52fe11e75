"""The program around the cycle: one instance, its folders, one run from the lock to the report."""
