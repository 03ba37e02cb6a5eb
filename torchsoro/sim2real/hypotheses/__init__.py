"""Effects that a simulation may have left out, each a module that is the identity at zero."""
