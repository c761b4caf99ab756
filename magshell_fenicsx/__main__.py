from magshell_fenicsx.cli import app

app()
