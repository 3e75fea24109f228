"""Checks of this machine and installation: ``python -m bgpo_trl.doctor``.

Each check prints a line: ``ok``; ``note``, usable with a limitation; or ``wrong``, unusable and
exit status 1. Checks import third-party packages themselves, so that a broken one is reported too.
"""
