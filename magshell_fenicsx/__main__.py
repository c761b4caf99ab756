import gc

gc.disable()  # what is imported stays
from magshell_fenicsx.cli import main  # noqa: E402

gc.freeze()
gc.enable()
main()
