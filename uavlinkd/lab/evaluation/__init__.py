"""The evaluations: runs give records, records alone give figures and a report. The daemon imports nothing of it."""
