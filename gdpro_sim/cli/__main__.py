from gdpro_sim.cli import main

main()
