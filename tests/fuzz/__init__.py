"""Bytes that nobody meant, for every place where bytes from outside are read: no traceback may escape."""
