"""torchsoro: pneumatic soft robots designed by gradient through a differentiable visco-hyperelastic MPM.

The public names are listed in ``__init__.pyi``. Each is imported from its module when it is first used, so that the
command line answers before torch and Taichi are loaded.
"""

import lazy_loader

from torchsoro.version import VERSION

__version__ = VERSION

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
