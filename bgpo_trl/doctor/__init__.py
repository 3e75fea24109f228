"""Checks of this machine and installation: ``python -m bgpo_trl.doctor``.

One line for each thing: ``ok``; ``note``, which costs something; or ``wrong``, which makes it
unusable and the exit status 1. Only the standard library is imported before a check asks for more,
so that whatever is broken is told like everything else.
"""
