"""The sections of rigid bodies that press on the shell, one file a kind."""
