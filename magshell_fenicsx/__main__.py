from magshell_fenicsx.cli import main

main()
