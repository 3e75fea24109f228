"""Demonstrations and experience: recordings, the demonstration bank, replay buffers."""
