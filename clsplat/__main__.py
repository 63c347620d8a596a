from clsplat.cli import main

main()
