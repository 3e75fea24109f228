"""Demonstrations and experience: recording, embedding bank, replay buffers."""
