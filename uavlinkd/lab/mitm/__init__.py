"""A man in the middle and an emulated radio between two daemons. Neither has a key.
--"""
