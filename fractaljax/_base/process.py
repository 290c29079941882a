"""The mark of the process that imported fractaljax, which its forks share and no other has."""

import os

MARK = os.urandom(16)
