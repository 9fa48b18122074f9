"""Signatures and help of every command; imports nothing heavy."""
