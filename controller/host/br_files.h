/* Racing line, weights and settings from files, for hosts without Python and for the FMU. With
 * input/output and heap, and therefore no part of the library. 'bayesrace export' writes the files.
 *
 * Racing line and weights are little-endian, begin with a head of 32 bytes and end exactly where it
 * says:
 *
 *   0   magic, 8 bytes: "BRFMPATH" or "BRFMGPWT"
 *   8   schema, u32: 3
 *   12  body's length in bytes, u32
 *   16  FNV-1a hash (64 bit) of the body, u64
 *   24  training points per output that the controller has room for, u64: for tools, not read here
 *
 * Body of path.bin: spacing [m] f64, then rows of BR_PATH_COLUMNS f64, see br_mpc_set_path.
 * Body of weights.bin: identity of the discretised model, 256 bytes, and version of the weights,
 * 801 bytes, both zero padded; for each of the BR_NE outputs kernel u32, points n u32, offset,
 * scale, signal, noise f64, BR_NZ length scales f64, inputs n x BR_NZ f64, alpha n f64, see
 * br_mpc_gp.
 *
 * settings.txt: a line for each member of br_mpc_parameters, br_driving, br_mpc_probation and
 * br_estimation, its name and its number, or its numbers, in the C locale; what comes after # is a
 * comment. The limits of the inputs are the parameters'. What begins with "learned_" is for a model
 * with weights.
 *
 * Whatever a file holds, nothing is read beyond it.
 */
#ifndef BR_FILES_H
#define BR_FILES_H

#include "bayesrace_cycle.h"

#ifdef __cplusplus
extern "C" {
#endif

#define BR_FILE_PATH "path.bin"
#define BR_FILE_WEIGHTS "weights.bin"
#define BR_FILE_SETTINGS "settings.txt"
#define BR_IDENTITY_BYTES 256
#define BR_VERSION_CHARACTERS 200
#define BR_VERSION_BYTES (4 * BR_VERSION_CHARACTERS + 1) /* of UTF-8, and a 0 */
#define BR_FILE_HEAD_BYTES ((size_t)32)
#define BR_GP_HEAD_BYTES ((size_t)(2 * 4 + (4 + BR_NZ) * 8))

/* Of the largest weights: numbers in memory, and bytes of the file. */
#define BR_WEIGHTS_NUMBERS (BR_NE * (BR_NZ + (size_t)BR_GP_CAPACITY * (BR_NZ + 1)))
#define BR_WEIGHTS_BYTES                                         \
    (BR_FILE_HEAD_BYTES + BR_IDENTITY_BYTES + BR_VERSION_BYTES + \
     BR_NE * (BR_GP_HEAD_BYTES + (size_t)BR_GP_CAPACITY * (BR_NZ + 1) * 8))

/* What settings.txt holds. */
typedef struct {
    br_mpc_parameters parameters;
    br_driving driving;
    br_mpc_probation probation;
    br_estimation without_weights, with_weights; /* by such a model */
} br_settings;

/* Racing line and weights of the folder into mpc. 0, or -1 and a sentence in text. identity: of the
 * model that mpc predicts with (BR_MODEL_IDENTITY); weights for another one are refused. version:
 * where to put that of the weights, empty without any; NULL: nowhere. */
int br_files_load(br_mpc *mpc, const char *folder, const char *identity,
                  char version[BR_VERSION_BYTES], char *text, size_t size);

/* The weights of a file in memory beside those in use (br_mpc_stage_weights), as above; numbers:
 * room for BR_WEIGHTS_NUMBERS. Without input and output, and without heap. */
int br_files_stage(br_mpc *mpc, const unsigned char *file, size_t bytes, double *numbers,
                   const char *identity, char version[BR_VERSION_BYTES], char *text, size_t size);

/* The settings of the folder. 0, or -1 and a sentence in text. */
int br_files_settings(const char *folder, br_settings *settings, char *text, size_t size);

#ifdef __cplusplus
}
#endif
#endif
