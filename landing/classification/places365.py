"""The 365 classes of Places365 (Zhou et al., IEEE TPAMI 2018), for `landing.classification.labels`.
The split into indoor and outdoor classes is the data set's own."""

OUTDOOR = """
airfield                       road      airport
alley                          path      denseresidential
amphitheater                   building  stadium
amusement_park                 -         park
apartment_building/outdoor     building  denseresidential
aqueduct                       building  viaduct
arch                           building  -
army_base                      -         industrial
athletic_field/outdoor         field     playground
badlands                       field     bareland
balcony/exterior               building  -
bamboo_forest                  trees     forest
barn                           building  farmland
barndoor                       building  -
baseball_field                 field     baseballfield
bazaar/outdoor                 -         commercial
beach                          water     beach
beach_house                    building  resort
beer_garden                    -         -
boardwalk                      path      -
boat_deck                      -         -
boathouse                      building  pond
botanical_garden               trees     park
bridge                         water     bridge
building_facade                building  commercial
bullring                       field     stadium
butte                          -         mountain
cabin/outdoor                  building  sparseresidential
campsite                       -         -
campus                         building  school
canal/natural                  water     river
canal/urban                    water     river
canyon                         -         mountain
carrousel                      building  park
castle                         building  -
cemetery                       -         -
chalet                         building  sparseresidential
church/outdoor                 building  church
cliff                          -         mountain
coast                          water     beach
construction_site              building  industrial
corn_field                     field     farmland
corral                         field     farmland
cottage                        building  sparseresidential
courthouse                     building  center
courtyard                      path      square
creek                          water     river
crevasse                       -         mountain
crosswalk                      road      -
dam                            water     river
desert/sand                    field     desert
desert/vegetation              trees     desert
desert_road                    road      desert
diner/outdoor                  building  commercial
doorway/outdoor                building  -
downtown                       building  commercial
driveway                       road      sparseresidential
embassy                        building  center
excavation                     field     bareland
farm                           field     farmland
field/cultivated               field     farmland
field/wild                     lawn      meadow
field_road                     path      farmland
fire_escape                    building  -
fire_station                   building  commercial
fishpond                       water     pond
football_field                 field     playground
forest/broadleaf               trees     forest
forest_path                    trees     forest
forest_road                    road      forest
formal_garden                  -         park
fountain                       water     square
garage/outdoor                 building  -
gas_station                    building  commercial
gazebo/exterior                building  park
general_store/outdoor          building  commercial
glacier                        -         mountain
golf_course                    lawn      park
greenhouse/outdoor             building  farmland
grotto                         -         -
hangar/outdoor                 building  airport
harbor                         water     port
hayfield                       field     farmland
heliport                       -         airport
highway                        road      viaduct
hospital                       building  center
hot_spring                     water     pond
hotel/outdoor                  building  resort
house                          building  sparseresidential
hunting_lodge/outdoor          building  sparseresidential
ice_floe                       water     -
ice_shelf                      water     -
ice_skating_rink/outdoor       -         playground
iceberg                        water     -
igloo                          building  -
industrial_area                building  industrial
inn/outdoor                    building  resort
islet                          water     -
japanese_garden                -         park
junkyard                       -         industrial
kasbah                         building  denseresidential
kennel/outdoor                 building  -
lagoon                         water     pond
lake/natural                   water     pond
landfill                       field     bareland
landing_deck                   -         airport
lawn                           lawn      meadow
library/outdoor                building  center
lighthouse                     building  -
loading_dock                   building  industrial
lock_chamber                   water     river
mansion                        building  sparseresidential
manufactured_home              building  denseresidential
market/outdoor                 -         commercial
marsh                          water     -
mausoleum                      building  -
medina                         building  denseresidential
moat/water                     water     river
mosque/outdoor                 building  church
motel                          building  resort
mountain                       -         mountain
mountain_path                  path      mountain
mountain_snowy                 -         mountain
museum/outdoor                 building  center
oast_house                     building  farmland
ocean                          water     -
office_building                building  commercial
oilrig                         water     -
orchard                        trees     farmland
pagoda                         building  church
palace                         building  center
park                           -         park
parking_garage/outdoor         building  parking
parking_lot                    road      parking
pasture                        lawn      meadow
patio                          path      -
pavilion                       building  park
phone_booth                    -         -
picnic_area                    -         park
pier                           water     port
playground                     -         playground
plaza                          path      square
pond                           water     pond
porch                          building  -
promenade                      path      -
racecourse                     field     playground
raceway                        road      playground
raft                           water     river
railroad_track                 -         railwaystation
rainforest                     trees     forest
residential_neighborhood       building  mediumresidential
restaurant_patio               path      commercial
rice_paddy                     water     farmland
river                          water     river
rock_arch                      -         mountain
roof_garden                    building  -
rope_bridge                    -         bridge
ruin                           building  -
runway                         road      airport
sandbox                        field     playground
schoolhouse                    building  school
shed                           building  -
shopfront                      building  commercial
ski_resort                     -         mountain
ski_slope                      -         mountain
sky                            -         -
skyscraper                     building  commercial
slum                           building  denseresidential
snowfield                      -         bareland
soccer_field                   field     playground
stadium/baseball               building  stadium
stadium/football               building  stadium
stadium/soccer                 building  stadium
stage/outdoor                  building  -
street                         road      denseresidential
swamp                          water     forest
swimming_pool/outdoor          water     resort
synagogue/outdoor              building  church
temple/asia                    building  church
topiary_garden                 trees     park
tower                          building  -
tree_farm                      trees     farmland
tree_house                     trees     forest
trench                         field     bareland
tundra                         field     bareland
underwater/ocean_deep          water     -
valley                         -         mountain
vegetable_garden               field     farmland
viaduct                        -         viaduct
village                        building  sparseresidential
vineyard                       field     farmland
volcano                        -         mountain
volleyball_court/outdoor       field     playground
water_park                     water     resort
water_tower                    building  storagetanks
waterfall                      water     river
watering_hole                  water     pond
wave                           water     beach
wheat_field                    field     farmland
wind_farm                      field     farmland
windmill                       building  farmland
yard                           lawn      sparseresidential
zen_garden                     -         park
"""

INDOOR = """
airplane_cabin airport_terminal alcove amusement_arcade aquarium arcade archaelogical_excavation
archive arena/hockey arena/performance arena/rodeo art_gallery art_school art_studio artists_loft
assembly_line atrium/public attic auditorium auto_factory auto_showroom bakery/shop
balcony/interior ball_pit ballroom bank_vault banquet_hall bar basement basketball_court/indoor
bathroom bazaar/indoor beauty_salon bedchamber bedroom beer_hall berth biology_laboratory
bookstore booth/indoor bow_window/indoor bowling_alley boxing_ring burial_chamber bus_interior
bus_station/indoor butchers_shop cafeteria candy_store car_interior catacomb chemistry_lab
childs_room church/indoor classroom clean_room closet clothing_store cockpit coffee_shop
computer_room conference_center conference_room corridor delicatessen department_store
dining_hall dining_room discotheque dorm_room dressing_room drugstore elevator/door
elevator_lobby elevator_shaft engine_room entrance_hall escalator/indoor fabric_store
fastfood_restaurant flea_market/indoor florist_shop/indoor food_court galley garage/indoor
general_store/indoor gift_shop greenhouse/indoor gymnasium/indoor hangar/indoor hardware_store
home_office home_theater hospital_room hotel_room ice_cream_parlor ice_skating_rink/indoor
jacuzzi/indoor jail_cell jewelry_shop kindergarden_classroom kitchen laundromat lecture_room
legislative_chamber library/indoor living_room lobby locker_room market/indoor martial_arts_gym
mezzanine movie_theater/indoor museum/indoor music_studio natural_history_museum nursery
nursing_home office office_cubicles operating_room orchestra_pit pantry parking_garage/indoor
pet_shop pharmacy physics_laboratory pizzeria playroom pub/indoor reception recreation_room
repair_shop restaurant restaurant_kitchen sauna science_museum server_room shoe_shop
shopping_mall/indoor shower stable stage/indoor staircase storage_room subway_station/platform
supermarket sushi_bar swimming_hole swimming_pool/indoor television_room television_studio
throne_room ticket_booth toyshop train_interior train_station/platform utility_room
veterinarians_office waiting_room wet_bar youth_hostel
"""
